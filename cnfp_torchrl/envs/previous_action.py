"""The previous-action transform: what an actuator does now, beside what it is asked to do next."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from cnfp_torchrl.keys import PREVIOUS_ACTION_KEY


class PreviousAction(Transform):
    """Publish in every state the action that led to it, for limits of how fast actions change.

    A geometry reads it like any other entry of a state::

        class RateLimit(GeometryTransform):
            def constraint_set(self, tensordict):
                action = tensordict["previous_action"]
                return Box(action - 0.2, action + 0.2, validate_args=False)

        remembering = TransformedEnv(env, PreviousAction())
        env = constrain_env(remembering, RateLimit("rate", ["previous_action"]))

    After a reset it is the action that the actuators then have. To let a network see it, too,
    append ``CatTensors(["observation", "previous_action"], "observation", del_keys=False)``.

    Args:
        initial: The action after a reset, ``(d,)``, or a number for all components. It has to lie
            in the action bounds.
        key: The key to publish at.

    Raises:
        ValueError: when the specs are read, for an initial action of another size, or outside the
            action bounds.
    """

    def __init__(self, initial: Tensor | float = 0.0, key: NestedKey = PREVIOUS_ACTION_KEY) -> None:
        super().__init__(in_keys=[], out_keys=[key])
        self.register_buffer("initial", torch.as_tensor(initial))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        action_spec = self._action_spec()
        try:
            start = self._start(action_spec)
        except RuntimeError:
            raise ValueError(
                f"PreviousAction(initial=...): expected a number, or as many as an action has, "
                f"{action_spec.shape[-1]}, given shape {tuple(self.initial.shape)}"
            ) from None
        if not bool(action_spec.is_in(start)):
            raise ValueError(
                "PreviousAction(initial=...): expected an action inside the action bounds, given "
                f"{self.initial.tolist()}"
            )
        observation_spec[self.out_keys[0]] = action_spec.clone()
        return observation_spec

    def _action_spec(self) -> TensorSpec:
        return self.parent.full_action_spec[self.parent.action_key]

    def _start(self, action_spec: TensorSpec) -> Tensor:
        zero = action_spec.zero()
        return self.initial.to(zero).expand(zero.shape).clone()

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.parent.action_key)
        return next_tensordict.set(self.out_keys[0], action.clone())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Where only some agents are reset, the caller merges: the others keep theirs.
        return tensordict_reset.set(self.out_keys[0], self._start(self._action_spec()))
