"""Losses that TorchRL lacks."""

from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss
from cnfp_torchrl.objectives.sac import ConstrainedSACLoss
from cnfp_torchrl.objectives.sac_lagrangian import SACLagrangianLoss

__all__ = ["BatchedSACLoss", "ConstrainedSACLoss", "SACLagrangianLoss"]
