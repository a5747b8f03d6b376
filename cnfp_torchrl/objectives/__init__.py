"""Losses that TorchRL lacks."""

from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss
from cnfp_torchrl.objectives.sac import ConstrainedSACLoss, usual_target_entropy
from cnfp_torchrl.objectives.sac_lagrangian import SACLagrangianLoss
from cnfp_torchrl.objectives.soft_update import FusedSoftUpdate

__all__ = [
    "BatchedSACLoss",
    "ConstrainedSACLoss",
    "FusedSoftUpdate",
    "SACLagrangianLoss",
    "usual_target_entropy",
]
