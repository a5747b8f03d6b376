"""Steering a unicycle past two ellipses to the origin: dynamics, barrier rows, judge."""

from cnfp_torchrl.tasks.safe_control.geometry import barrier_rows
from cnfp_torchrl.tasks.safe_control.judge import barrier_excess
from cnfp_torchrl.tasks.safe_control.unicycle import (
    Costs,
    Problem,
    episode,
    nominal_control,
    starts,
)

__all__ = [
    "Costs",
    "Problem",
    "barrier_excess",
    "barrier_rows",
    "episode",
    "nominal_control",
    "starts",
]
