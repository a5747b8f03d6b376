"""Losses that TorchRL lacks."""

from cnfp_torchrl.objectives.sac import ConstrainedSACLoss

__all__ = ["ConstrainedSACLoss"]
