"""The audit of constraint geometry against an environment's own indicators: ``cnfp-audit``."""

from cnfp_torchrl.audit.auditing import AuditSettings, audit
from cnfp_torchrl.audit.distortion import Distortion, measure_distortion
from cnfp_torchrl.audit.report import (
    TOGETHER,
    AuditReport,
    ConstraintMetrics,
    Executed,
    WorstState,
)
from cnfp_torchrl.audit.statistics import Quantiles, Share

__all__ = [
    "TOGETHER",
    "AuditReport",
    "AuditSettings",
    "ConstraintMetrics",
    "Distortion",
    "Executed",
    "Quantiles",
    "Share",
    "WorstState",
    "audit",
    "measure_distortion",
]
