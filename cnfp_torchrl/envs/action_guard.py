"""The transform that refuses to execute actions that break a constraint."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import Transform

from cnfp_torchrl.envs.geometry_inputs import with_geometry
from cnfp_torchrl.keys import require
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    changed_actions,
    constraint_bijectors,
    refuse_relaxed,
    refuse_violations,
)


class ActionGuard(Transform):
    """Raise before an action outside a constraint's set or the action bounds is executed.

    Whoever chose it: an actor, ``env.rand_action``, a collector's ``init_random_frames``. The check
    is that of `cnfp_torchrl.modules.ExecutedActionGuard`, with zero tolerance, and never repairs.
    Append it right after the constraints: what is appended behind it, and changes actions, does so
    before it sees them::

        env = constrain_env(env, SpeedLimit(), KeepDistance())
        env.append_transform(ActionGuard())

    One step is one action in one state: a transform that repeats actions in states that nobody
    sees, such as `torchrl.envs.FrameSkipTransform`, belongs into the environment that is
    constrained, whose geometry must then hold for all of these steps.
    `torchrl.envs.check_env_specs` acts at random: call it before.

    Args:
        refuse_relaxation: Whether to raise, too, in states in which a constraint is not active,
            whatever the action. A set without interior, such as an equality, is never active.

    Raises:
        ValueError: when the environment publishes no constraint or no anchor, or changes actions
            between its constraints and the guard.
        ConstraintViolationError: at a step, naming constraint, batch index, action and slack.
        RelaxedConstraintError: at a step, with `refuse_relaxation`.
    """

    def __init__(self, *, refuse_relaxation: bool = False) -> None:
        super().__init__()
        self.refuse_relaxation = refuse_relaxation
        # Made once the environment is known; a module, to move with the environment.
        self._head: ConstrainedFlowModule | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        head = self._flow_head()
        action = require(tensordict, head.action_key, "call a policy before the step").detach()
        region = head.get_region(tensordict)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            # What is not executed needs no check; the anchor passes it.
            stepped = stepped.reshape(tensordict.batch_size)
            action = torch.where(stepped.unsqueeze(-1), action, region.anchor.to(action.dtype))
        if self.refuse_relaxation:
            refuse_relaxed(head.order, region, stepped)
        refuse_violations(head.order, region, action)
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        # Read at the root: batched environments must pass it to their workers.
        return with_geometry(input_spec, self.parent.observation_spec, self._flow_head())

    def _flow_head(self) -> ConstrainedFlowModule:
        if self._head is None:
            if self.parent is None:
                raise RuntimeError(
                    "ActionGuard: expected to be part of an environment, which knows the "
                    "constraints, before use; append it with env.append_transform"
                )
            if (changing := changed_actions(self.parent)) is not None:
                raise ValueError(
                    "ActionGuard: expected to be appended before transforms that change actions, "
                    f"given one behind {changing}, which would change them after the check; append "
                    "it right after constrain_env"
                )
            self._head = ConstrainedFlowModule(
                self.parent.action_spec_unbatched,
                constraint_bijectors(self.parent),
                out_key=self.parent.action_key,
            )
        return self._head
