"""The map from free actions, of agents that know no constraints, to allowed ones."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, TensorSpec, Unbounded

from cnfp_torchrl.keys import refuse_non_finite, require
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule
from cnfp_torchrl.modules.latent import FlowMap


class FreeActionMap(FlowMap):
    r"""Map a free action to an allowed one, in its place in the tensordict.

    A free action lies in :math:`[-1, 1]^d`; its latent is :math:`\mathrm{artanh}(u)`, so that it
    is stretched linearly onto the action bounds where no constraint binds. What is outside is
    clipped to the nearest number below 1, as environments clip actions. Or it lies in R^d, and is
    the latent itself.

    Args:
        head: The flow module that knows constraints and action bounds.
        unbounded: Whether free actions are of R^d.

    Raises:
        ValueError: when called on an action that is not finite, or of another dimension.
        MissingGeometryError: when called without an action, or without the geometry.
    """

    def __init__(self, head: ConstrainedFlowModule, *, unbounded: bool = False) -> None:
        super().__init__(head, latent_key=head.action_key)
        self.unbounded = unbounded

    @property
    def spec(self) -> TensorSpec:
        """The spec of free actions in one state, ``(d,)``."""
        bounds = self.head.bounds
        options = {"dtype": bounds.dtype, "device": bounds.low.device}
        if self.unbounded:
            return Unbounded(bounds.low.shape, **options)
        return Bounded(-1.0, 1.0, bounds.low.shape, **options)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the allowed action ``(*batch, d)`` in the place of the free one."""
        free = require(tensordict, self.latent_key, "choose an action before the step")
        refuse_non_finite(str(self.latent_key), free, "look for the agent's first NaN")
        if not self.unbounded:
            largest = 1 - torch.finfo(free.dtype).eps
            tensordict.set(self.latent_key, free.clamp(-largest, largest).atanh())
        return super().forward(tensordict)
