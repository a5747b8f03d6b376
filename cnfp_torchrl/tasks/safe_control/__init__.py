"""Steering a unicycle past two ellipses to the origin: motion, environment, barriers, judge."""

from cnfp_torchrl.tasks.safe_control.env import SafeControlEnv
from cnfp_torchrl.tasks.safe_control.geometry import BarrierGeometry, barrier_rows
from cnfp_torchrl.tasks.safe_control.judge import barrier_excess
from cnfp_torchrl.tasks.safe_control.unicycle import (
    Costs,
    Problem,
    encoded,
    episode,
    nominal_control,
    starts,
)

__all__ = [
    "BarrierGeometry",
    "Costs",
    "Problem",
    "SafeControlEnv",
    "barrier_excess",
    "barrier_rows",
    "encoded",
    "episode",
    "nominal_control",
    "starts",
]
