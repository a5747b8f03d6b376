"""MuJoCo's robots under limits of power, effort and rate: environment, judges, geometry."""

from cnfp_torchrl.tasks.robots.env import RobotEnv, robot_with_previous_action
from cnfp_torchrl.tasks.robots.geometry import (
    BentEffortLimit,
    DrawnPowerLimit,
    PowerLimit,
    RateLimit,
)
from cnfp_torchrl.tasks.robots.judges import (
    BentEffortJudge,
    DrawnPowerJudge,
    Judge,
    PowerJudge,
    RateJudge,
)

__all__ = [
    "BentEffortJudge",
    "BentEffortLimit",
    "DrawnPowerJudge",
    "DrawnPowerLimit",
    "Judge",
    "PowerJudge",
    "PowerLimit",
    "RateJudge",
    "RateLimit",
    "RobotEnv",
    "robot_with_previous_action",
]
