"""Losses that TorchRL lacks."""

from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss
from cnfp_torchrl.objectives.fused_adam import FusedAdam
from cnfp_torchrl.objectives.ppo import ConstrainedPPOLoss
from cnfp_torchrl.objectives.sac import ConstrainedSACLoss, usual_target_entropy
from cnfp_torchrl.objectives.sac_lagrangian import SACLagrangianLoss
from cnfp_torchrl.objectives.soft_update import FusedSoftUpdate
from cnfp_torchrl.objectives.td3 import ConstrainedTD3Loss

__all__ = [
    "BatchedSACLoss",
    "ConstrainedPPOLoss",
    "ConstrainedSACLoss",
    "ConstrainedTD3Loss",
    "FusedAdam",
    "FusedSoftUpdate",
    "SACLagrangianLoss",
    "usual_target_entropy",
]
