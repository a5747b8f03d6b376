"""Point navigation as a Gymnasium environment, on the same dynamics."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from cnfp_torchrl.tasks.point_nav.dynamics import (
    CONSTRAINT_NAMES,
    Collision,
    PointNavDynamics,
    State,
)
from cnfp_torchrl.tasks.point_nav.layout import EPISODE_STEPS, Layout
from cnfp_torchrl.tasks.point_nav.rendering import render_point_nav

POINT_NAV_ID = "cnfp_torchrl/PointNav-v0"
"""The id for ``gymnasium.make``, known once `cnfp_torchrl.tasks.point_nav` is imported."""

Array = NDArray[np.float32]


class PointNavGymnasiumEnv(gymnasium.Env[Array, Array]):
    """One agent of `PointNavEnv`; ``gymnasium.make`` truncates its episodes after 100 steps.

    Every info holds ``cost``, the indicators as a float32 array in the order of
    ``metadata["constraint_names"]``, zeros after a reset. A reset to a chosen state:
    ``reset(options={"position": ..., "battery": ..., "goal": ...})``, any of the three.

    Args:
        layout: The map; None takes the reference task.
        collision: The effect of a collision, ``pass`` or ``block``, see `PointNavEnv`.
        render_mode: The kind of picture: None, or ``rgb_array``, 512 x 512 pixels.

    Raises:
        ValueError: for a bad argument or option, and for an action with NaN.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "constraint_names": CONSTRAINT_NAMES,
    }

    def __init__(
        self,
        layout: Layout | None = None,
        collision: Collision = "pass",
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode: expected None or one of {self.metadata['render_modes']}, "
                f"given {render_mode!r}"
            )
        self.render_mode = render_mode
        self.dynamics = PointNavDynamics(layout, collision)
        wall = self.dynamics.layout.wall
        self.observation_space = gymnasium.spaces.Box(
            np.array([-wall, -wall, 0, -wall, -wall], dtype=np.float32),
            np.array([wall, wall, 1, wall, wall], dtype=np.float32),
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._generator: torch.Generator | None = None
        self._state: State | None = None
        self._trail: list[tuple[float, float]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode in a drawn state, or in that of the options."""
        super().reset(seed=seed)
        if seed is not None or self._generator is None:
            self._generator = torch.Generator().manual_seed(int(self.np_random.integers(2**62)))
        try:
            self._state = self.dynamics.sample(torch.Size(), self._generator, **(options or {}))
        except TypeError:
            raise ValueError(
                "options: expected a dict with any of 'position', 'battery' and 'goal', "
                f"given {options!r}"
            ) from None
        self._trail = [self._position()]
        return self._state.observation().numpy(), {"cost": np.zeros(len(CONSTRAINT_NAMES), "f4")}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move; an action outside [-1, 1] is clipped."""
        if self._state is None or self._generator is None:
            raise gymnasium.error.ResetNeeded("step: expected a call of reset() first")
        given = np.asarray(action, dtype=np.float32)
        if given.shape != (2,) or np.isnan(given).any():
            raise ValueError(f"action: expected two numbers, given {action!r}")
        outcome = self.dynamics.step(self._state, torch.from_numpy(given), self._generator)
        self._state = outcome.state
        self._trail.append(self._position())
        observation, cost = outcome.state.observation().numpy(), outcome.cost.numpy()
        return observation, outcome.reward.item(), False, False, {"cost": cost}

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture of the state and the way so far, or None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        state = self._state
        return render_point_nav(
            self.dynamics.layout,
            position=self._position(),
            battery=int(state.battery),
            goal=(float(state.goal[0]), float(state.goal[1])),
            trail=self._trail,
        )

    def _position(self) -> tuple[float, float]:
        assert self._state is not None
        x, y = self._state.position.tolist()
        return x, y


def register() -> None:
    """Make `POINT_NAV_ID` known to Gymnasium; importing this package does it."""
    if POINT_NAV_ID not in gymnasium.registry:
        gymnasium.register(
            POINT_NAV_ID,
            entry_point=f"{__name__}:{PointNavGymnasiumEnv.__name__}",
            max_episode_steps=EPISODE_STEPS,
        )
