"""The transform that lets any agent act within the constraints: the flow as part of the world."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from cnfp_torchrl.envs.geometry_inputs import with_geometry
from cnfp_torchrl.keys import EXECUTED_ACTION_KEY
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    Flow,
    FreeActionMap,
    constraint_bijectors,
    resolve_safe_flow,
)


class ConstrainedActions(Transform):
    """Map every action of an agent to an allowed one; the agent knows nothing of constraints.

    The flow stands in front of the environment instead of at the end of an actor: the agent acts in
    [-1, 1]^d, whatever the action bounds, and what is executed lies in all sets. It keeps its own
    exploration, densities and losses, all in terms of its free actions, and so needs neither
    `constrain` nor a safe warm-up; ``env.rand_action`` is safe, too::

        env = constrain_env(env, SpeedLimit(), KeepDistance())
        env.append_transform(ConstrainedActions())

    ``executed_action`` under ``next``, ``(*batch, d)``, is what was executed; zeros after a reset.
    The counterpart for Gymnasium is `cnfp_torchrl.wrappers.ConstrainedActions`.

    Args:
        flow: The rule that combines the sets, see `cnfp_torchrl.modules.ConstrainedFlowModule`; one
            that guarantees nothing is refused.
        unbounded: Whether the agent acts in R^d instead, as one with a plain Gaussian does.

    Raises:
        ValueError: when the environment publishes no constraint, for a flow that guarantees
            nothing, and at a step for an action that is not finite.
    """

    def __init__(self, flow: Flow | str = "exact", *, unbounded: bool = False) -> None:
        super().__init__()
        self._flow = resolve_safe_flow(flow)
        self.unbounded = unbounded
        # Made once the environment is known; a module, to move with the environment.
        self._map: FreeActionMap | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._action_map()(tensordict)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        action_map = self._action_map()
        input_spec = with_geometry(input_spec, self.parent.observation_spec, action_map.head)
        action_spec, key = input_spec["full_action_spec"], action_map.head.action_key
        action_spec[key] = action_map.spec.expand(action_spec[key].shape)
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        key = self._action_map().head.action_key
        executed = self.parent.full_action_spec[key]
        observation_spec[EXECUTED_ACTION_KEY] = Unbounded(
            executed.shape, device=executed.device, dtype=executed.dtype
        )
        return observation_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        executed = tensordict.get(self._action_map().head.action_key)
        return next_tensordict.set(EXECUTED_ACTION_KEY, executed)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Where only some agents are reset, the caller merges.
        zero = self.container.observation_spec[EXECUTED_ACTION_KEY].zero()
        return tensordict_reset.set(EXECUTED_ACTION_KEY, zero)

    def _action_map(self) -> FreeActionMap:
        if self._map is None:
            if self.parent is None:
                raise RuntimeError(
                    "ConstrainedActions: expected to be part of an environment, which knows the "
                    "constraints, before use; append it with env.append_transform"
                )
            head = ConstrainedFlowModule(
                self.parent.action_spec_unbatched,
                constraint_bijectors(self.parent),
                flow=self._flow,
                out_key=self.parent.action_key,
            )
            self._map = FreeActionMap(head, unbounded=self.unbounded)
            # What tells everybody that actions are not the environment's own.
            self.in_keys_inv = self.out_keys_inv = [head.action_key]
        return self._map
