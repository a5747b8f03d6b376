"""The geometry: the actions that the policy will keep to, computed from what a state shows."""

from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import Box, ConstraintSet

from .environment import STEP
from .judge import LIMIT

MARGIN = 1e-5
"""The distance that is kept to the limit, in m/s: float32 rounds such speeds by less."""


class SpeedLimit(GeometryTransform):
    """The accelerations after which the speed is within the limit, ``|v + STEP a| <= LIMIT``."""

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        """Return a box of accelerations for each state.

        It is to leave an action in the next state, too. This one does, as one can always brake; a
        wall, for example, needs a set that keeps the distance in which one can stop.
        """
        velocity = tensordict["observation"][..., 2:]
        fastest = LIMIT - MARGIN
        return Box((-fastest - velocity) / STEP, (fastest - velocity) / STEP, validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
        """Return a braking, known to keep the limit in every state that keeps it.

        Where you know none, leave this method out: an allowed action is then searched for.
        """
        return -tensordict["observation"][..., 2:]
