"""The audit of constraint geometry against an environment's own indicators: ``cnfp-audit``."""

from cnfp_torchrl.audit.auditing import AuditSettings, audit
from cnfp_torchrl.audit.command import FLAWS_FOUND, audit_configured, main
from cnfp_torchrl.audit.report import AuditReport, Findings, Scene, Share
from cnfp_torchrl.audit.states import Place, place_point_nav
from cnfp_torchrl.audit.table import as_text

__all__ = [
    "FLAWS_FOUND",
    "AuditReport",
    "AuditSettings",
    "Findings",
    "Place",
    "Scene",
    "Share",
    "as_text",
    "audit",
    "audit_configured",
    "main",
    "place_point_nav",
]
