"""The state of the environment in the middle of its episodes, where it can be taken."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv


class EpisodesBeginAnewWarning(UserWarning):
    """The environment does not give its state, so that a resumed run begins new episodes."""


class CollectorState:
    """What a collector and its environment have to remember: counts, and the running episodes.

    An environment that is not among those of `environment_state` begins new episodes when a run is
    resumed; the steps of the broken ones are in the replay buffer, their returns are not counted.

    Args:
        collector: The collector, which has been made and not iterated over.
        env: The collector's environment.
    """

    def __init__(self, collector: BaseCollector, env: EnvBase) -> None:
        self._collector, self._env = collector, env

    @property
    def resumes_episodes(self) -> bool:
        """Tell whether the running episodes can be gone on with."""
        return self.why_episodes_begin_anew is None

    @property
    def why_episodes_begin_anew(self) -> str | None:
        """The reason why the running episodes cannot be gone on with, None where they can."""
        if not hasattr(self._collector, "_carrier"):
            return "those of a collector with workers are not saved"
        if environment_state(self._env) is not None:
            return None
        bare = self._env
        while isinstance(bare, TransformedEnv):
            bare = bare.base_env
        return f"{type(bare).__name__} does not give its state"

    def state_dict(self) -> dict[str, Any]:
        """Return counts, the environment's state, and the state that the policy acts in next."""
        state = dict(self._collector.state_dict())
        # The policy is a component of its own, and of the environment these are the transforms.
        for name in ("policy_state_dict", "env_state_dict"):
            state.pop(name, None)
        if self.resumes_episodes:
            # TorchRL gives no other way to the states that the next step starts from.
            state["carrier"] = self._collector._carrier.to_dict()
            state["environment"] = environment_state(self._env)
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where the state was taken."""
        state = dict(state)
        carrier, environment = state.pop("carrier", None), state.pop("environment", None)
        self._collector.load_state_dict(state, strict=False)
        if carrier is not None:
            now = self._collector._carrier
            self._collector._carrier = TensorDict.from_dict(
                carrier, batch_size=now.batch_size, device=now.device
            )
            restore_environment(self._env, environment)


def environment_state(env: EnvBase) -> dict[str, Any] | None:
    """Return an environment's state with that of its transforms; None if it does not give it.

    Given is the state of environments with a ``state_dict`` of their own, as all tasks of this
    package have it, of several of them (SerialEnv, ParallelEnv), and of Gymnasium's MuJoCo tasks.
    """
    if isinstance(env, TransformedEnv):
        base = environment_state(env.base_env)
        return None if base is None else {"base": base, "transforms": env.transform.state_dict()}
    if isinstance(env, GymWrapper):
        return _gymnasium_state(env)
    state = env.state_dict()
    return dict(state) if _holds_something(state) else None


def restore_environment(env: EnvBase, state: Mapping[str, Any]) -> None:
    """Bring an environment into a state that `environment_state` has returned."""
    if isinstance(env, TransformedEnv):
        restore_environment(env.base_env, state["base"])
        env.transform.load_state_dict(state["transforms"])
    elif isinstance(env, GymWrapper):
        _restore_gymnasium(env, state)
    else:
        env.load_state_dict(state)


def _holds_something(state: Any) -> bool:
    """Tell whether every environment of several has a state."""
    if not isinstance(state, Mapping):
        return True
    workers = [value for name, value in state.items() if str(name).startswith("worker")]
    return all(map(_holds_something, workers)) if workers else bool(state)


def _gymnasium_state(env: GymWrapper) -> dict[str, Any] | None:
    layers = list(_layers(env))
    if (physics := _mujoco(layers[-1])) is None:
        return None
    return {
        "physics": _physics_state(*physics),
        "random": layers[-1].np_random.bit_generator.state,
        "layers": [_plain_values(layer) for layer in layers],
    }


def _restore_gymnasium(env: GymWrapper, state: Mapping[str, Any]) -> None:
    layers = list(_layers(env))
    physics = _mujoco(layers[-1])
    assert physics is not None
    _restore_physics(*physics, state["physics"])
    layers[-1].np_random.bit_generator.state = state["random"]
    for layer, values in zip(layers, state["layers"], strict=True):
        vars(layer).update({name: value for name, value in values.items() if name in vars(layer)})


def _layers(env: GymWrapper) -> Iterator[Any]:
    """Yield Gymnasium's wrappers, such as the one that counts steps, and the task within them."""
    layer = env._env
    yield layer
    while layer is not layer.unwrapped:
        layer = layer.env
        yield layer


def _plain_values(layer: Any) -> dict[str, Any]:
    """Return the attributes that are numbers or flags: the counters among them."""
    return {name: value for name, value in vars(layer).items() if isinstance(value, int | float)}


def _mujoco(task: Any) -> tuple[Any, Any] | None:
    """Return the model and data of a MuJoCo task; there is none where MuJoCo is not imported."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is None or not isinstance(getattr(task, "data", None), mujoco.MjData):
        return None
    return task.model, task.data


def _physics_state(model: Any, data: Any) -> dict[str, Any]:
    """Return the state that MuJoCo integrates from, and what was derived from the one before.

    Tasks read derived quantities, such as positions of bodies, before the next step computes them.
    """
    mujoco = sys.modules["mujoco"]
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    integrated = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, integrated, kind)
    derived = {name: torch.from_numpy(value.copy()) for name, value in _arrays(data)}
    return {"integrated": torch.from_numpy(integrated), "derived": derived}


def _restore_physics(model: Any, data: Any, state: Mapping[str, Any]) -> None:
    mujoco = sys.modules["mujoco"]
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_setState(model, data, state["integrated"].numpy(), kind)
    mujoco.mj_forward(model, data)
    for name, value in _arrays(data):
        saved = state["derived"][name].numpy()
        # Those of contacts have as many rows as there are contacts, and are computed anew.
        if saved.shape == value.shape:
            value[...] = saved


def _arrays(data: Any) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    for name in dir(data):
        if not name.startswith("_") and isinstance(value := getattr(data, name), np.ndarray):
            yield name, value
