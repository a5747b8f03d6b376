"""Pictures of an environment as it renders itself."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.envs.task_view import environment_layers
from cnfp_torchrl.keys import PIXELS_KEY


class Camera:
    """Take pictures of an environment that has a method ``render``, of the first in a batch.

    An environment of Gymnasium may have been made without a ``render_mode``: it is asked for an
    array all the same. One that cannot render is warned of once, and shows nothing.

    Args:
        env: The environment, with any transforms.
    """

    def __init__(self, env: EnvBase) -> None:
        self._env = env
        self._can_render = True

    def picture(self) -> Tensor | None:
        """Return a picture of the current state, uint8 ``(height, width, 3)``, or None."""
        renderer = next((x for x in environment_layers(self._env) if _renders(x)), None)
        if renderer is None or not self._can_render:
            return None
        try:
            rendered = _render(renderer)
        except Exception as error:  # other libraries', which fail in any way
            warnings.warn(
                f"{type(renderer).__name__} cannot render: {error}; nothing else is lost. MuJoCo "
                "without a display needs MUJOCO_GL=egl or MUJOCO_GL=osmesa, or switch pictures off "
                "with visual.render_every=0",
                stacklevel=2,
            )
            rendered = None
        self._can_render = rendered is not None
        return rendered


def can_render(env: EnvBase | None) -> bool:
    """Tell whether an environment shows pictures: published at ``pixels``, or rendered."""
    if env is None:
        return False
    published = PIXELS_KEY in env.observation_spec.keys()  # noqa: SIM118
    return published or any(map(_renders, environment_layers(env)))


def _renders(layer: object) -> bool:
    # Every environment of Gymnasium has the method, of which that of the base class only raises.
    render = getattr(type(layer), "render", None)
    return callable(render) and render is not gymnasium.Env.render


def _render(renderer: Any) -> Tensor | None:
    mode = getattr(renderer, "render_mode", "rgb_array")
    modes = (getattr(renderer, "metadata", None) or {}).get("render_modes", ())
    if mode is None and "rgb_array" in modes:
        renderer.render_mode = "rgb_array"
    try:
        rendered = renderer.render()
    finally:
        if mode is None:
            renderer.render_mode = None
    if not isinstance(rendered, np.ndarray) or rendered.ndim != 3 or rendered.shape[-1] != 3:
        return None
    return torch.from_numpy(np.ascontiguousarray(rendered, dtype=np.uint8).copy())
