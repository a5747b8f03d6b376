"""Hold a constraint's geometry against the environment's own indicators: ``cnfp-audit``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from cnfp_torchrl.audit.auditing import AuditSettings, audit
from cnfp_torchrl.audit.report import AuditReport
from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import require_settings
from cnfp_torchrl.whole_file import whole_file

FLAWS_FOUND = 3
"""The exit code where flaws were found; 1 is an audit that could not be done."""


def audit_configured(config: DictConfig) -> AuditReport:
    """Return the audit of a configuration composed from ``conf/audit.yaml``."""
    require_settings(config)
    settings: AuditSettings = instantiate(config.audit)
    chosen, folder = config, None
    if config.run is not None:
        folder = RunFolder.open(config.run)
        chosen = folder.load_config(tuple(config.trusted))
    env = build_environment(chosen, batch_size=[config.batch], with_anchor=True)
    return audit(
        env,
        order=list(chosen.flow.order),
        flow=instantiate(chosen.flow.combine),
        actor=None if folder is None else load_actor(folder, chosen, env),
        place=instantiate(chosen.env.get("place")),
        settings=settings,
    )


@hydra.main(config_path=str(config_directory()), config_name="audit", version_base="1.3")
def main(config: DictConfig) -> None:
    """Audit, print tables, write ``audit.json`` and ``audit.png``; exit with 3 for a flaw."""
    report = audit_configured(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    text = json.dumps(report.as_dict(), indent=2, allow_nan=False)
    with whole_file(folder / "audit.json") as file:
        file.write(f"{text}\n".encode())
    draw: Callable[[AuditReport, Path], Path] | None = instantiate(config.figure)
    if draw is not None:
        draw(report, folder / "audit.png")
    sys.stdout.write(f"{report}\n{folder}\n")
    if report.flaws:
        sys.exit(FLAWS_FOUND)
