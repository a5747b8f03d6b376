"""Losses that TorchRL lacks."""

from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss
from cnfp_torchrl.objectives.sac import ConstrainedSACLoss
from cnfp_torchrl.objectives.sac_lagrangian import SACLagrangianLoss
from cnfp_torchrl.objectives.soft_update import FusedSoftUpdate

__all__ = ["BatchedSACLoss", "ConstrainedSACLoss", "FusedSoftUpdate", "SACLagrangianLoss"]
