"""Train a policy that cannot break its constraints: the command ``cnfp-train``."""

from __future__ import annotations

import sys

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate
    from omegaconf import DictConfig, OmegaConf

    from cnfp_torchrl.configuration import config_directory
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.training.train import train
    from cnfp_torchrl.whole_file import whole_file


def _save_hydra_files(folder: RunFolder, config: DictConfig) -> None:
    """Write what Hydra would, who would write it over that of a run whose folder it is."""
    hydra_config = HydraConfig.get()
    contents = {
        "config": config,
        "hydra": {"hydra": hydra_config},
        "overrides": hydra_config.overrides.task,
    }
    directory = folder.path / ".hydra"
    directory.mkdir(exist_ok=True)
    for name, content in contents.items():
        with whole_file(directory / f"{name}.yaml") as file:
            file.write(OmegaConf.to_yaml(content).encode())


@hydra.main(config_path=str(config_directory()), config_name="train", version_base="1.3")
def main(config: DictConfig) -> float | None:
    """Train, draw the run's figures, print the summary, and return the score for sweeps."""
    folder = RunFolder.create(HydraConfig.get().runtime.output_dir)
    _save_hydra_files(folder, config)
    summary = train(config, folder)
    if config.figures:
        instantiate(config.figures)(folder)
    violations = ", ".join(f"{name} {count}" for name, count in summary["violations"].items())
    score = "" if summary["score"] is None else f", score {summary['score']:.3f}"
    sys.stdout.write(
        f"return {summary['return_mean']:.2f}{score}; violations: {violations or 'not counted'}; "
        f"{summary['steps']} steps in {summary['seconds']:.0f} s\n{folder.path}\n"
    )
    return summary["score"]


if __name__ == "__main__":
    main()
