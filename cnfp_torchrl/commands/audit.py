"""Compare constraint sets with the environment's own indicators: the command ``cnfp-audit``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate
    from omegaconf import DictConfig

    from cnfp_torchrl.audit import AuditReport, AuditSettings, audit
    from cnfp_torchrl.commands.hydra_command import hydra_command
    from cnfp_torchrl.configuration import require_settings
    from cnfp_torchrl.training.agent import build_environment, load_actor
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.whole_file import write_json

FLAWS_FOUND = 3
"""The exit code where flaws were found; 1 is an audit that could not be done."""


def audit_configured(config: DictConfig) -> AuditReport:
    """Return the audit of a configuration composed from ``conf/audit.yaml``."""
    require_settings(config)
    settings: AuditSettings = instantiate(config.audit)
    audited, folder = config, None
    if config.run is not None:
        folder = RunFolder.open(config.run, config.checkpoint)
        audited = folder.load_config(config.trusted)
    env = build_environment(audited, batch_size=[config.batch], with_anchor=True)
    return audit(
        env,
        flow=instantiate(audited.flow),
        actor=None if folder is None else load_actor(folder, audited, env),
        state_setter=instantiate(audited.env.get("state_setter")),
        settings=settings,
    )


@hydra_command("audit")
def main(config: DictConfig) -> None:
    """Audit, print tables, write ``audit.json`` and ``audit.png``; exit with 3 for a flaw."""
    draw: Callable[[AuditReport, Path], Path] | None = instantiate(config.figure)
    report = audit_configured(config)
    directory = Path(HydraConfig.get().runtime.output_dir)
    write_json(directory / "audit.json", report.as_dict())
    if draw is not None:
        draw(report, directory / "audit.png")
    sys.stdout.write(f"{report}\n{directory}\n")
    if report.flaws:
        sys.exit(FLAWS_FOUND)


if __name__ == "__main__":
    main()
