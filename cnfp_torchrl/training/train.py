"""Train a policy that cannot break its constraints: the command ``cnfp-train``."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.modules import WarmUpPolicy, flow_head, guarded
from cnfp_torchrl.training.agent import build_actor, build_environment, build_loss
from cnfp_torchrl.training.environment import counted_constraints
from cnfp_torchrl.training.evaluation import Evaluation, LinearScore, evaluate_seeded
from cnfp_torchrl.training.metrics import Metrics
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import (
    EvaluationSettings,
    TrainingSettings,
    require_frames,
    require_settings,
)
from cnfp_torchrl.training.storage import prepare_buffer
from cnfp_torchrl.training.update import Update
from cnfp_torchrl.training.watching import (
    RECORDING,
    EpisodeCollector,
    TrainingWatcher,
    Unwatched,
    Watch,
    first_episodes,
)
from cnfp_torchrl.whole_file import whole_file


def train(config: DictConfig, folder: RunFolder) -> dict[str, Any]:
    """Train, evaluate and leave everything in the run's folder.

    Args:
        config: as composed from ``conf/train.yaml``.
        folder: an empty one.

    Returns:
        The summary that is also written to ``summary.json``.

    Raises:
        ValueError: before any work, for a setting that makes no sense.
    """
    with closing(folder):
        return _train(config, folder)


def _train(config: DictConfig, folder: RunFolder) -> dict[str, Any]:
    started = time.perf_counter()
    require_settings(config)
    settings: TrainingSettings = instantiate(config.training)
    judgment: EvaluationSettings = instantiate(config.evaluation)
    require_frames(config)
    score = instantiate(config.env.get("score"))
    watch: Watch | None = instantiate(config.visual, _convert_="all") or None
    torch.manual_seed(config.seed)
    torch.set_num_threads(config.threads)

    # Environment and agent
    env = build_environment(config, with_penalty=True)
    env.set_seed(config.seed)
    actor = build_actor(config, env)
    loss = build_loss(config, env, actor)
    target = instantiate(config.target, _partial_=True)(loss)
    optimizer = instantiate(config.optim, _partial_=True)(loss.parameters())
    update = Update(loss, optimizer, target, compiled=config.compile)

    # Data
    policy = WarmUpPolicy(actor, settings.warmup_frames)
    if config.compile:
        # Not the policy around it, which counts: a number that changes would be compiled anew.
        policy.actor = torch.compile(actor)
    collector = instantiate(config.collector, _partial_=True)(env, policy)
    # A collector tries its policy once when it is made, which is not a step of the warm-up.
    policy.frames_left = settings.warmup_frames
    buffer = instantiate(config.replay_buffer)
    kept = prepare_buffer(
        buffer,
        env,
        actor.in_keys,
        other_keys=[key for key in [("next", "cost")] if key in loss.in_keys],
        constraint_bytes=settings.constraint_bytes,
    )

    watcher: TrainingWatcher = Unwatched()
    if watch is not None:
        watcher = watch.of_training(folder.path / RECORDING, actor, env)
    folder.save_config(config)
    loggers = [
        make(log_dir=str(folder.path)) for make in (instantiate(config.logger) or {}).values()
    ]
    metrics = Metrics(
        [*loggers, *watcher.loggers],
        counted_constraints(env),
        total_frames=config.collector.total_frames,
        interval=settings.log_interval,
    )

    owed = 0.0
    with closing(watcher):
        for collected in collector:
            watcher.see(collected)
            batch = collected.reshape(-1)
            metrics.add_steps(batch)
            buffer.extend(batch.select(*kept))
            if metrics.frames >= settings.warmup_frames:
                owed += batch.numel() * settings.update_ratio
                while owed >= 1:
                    metrics.add_losses(update(buffer.sample()))
                    owed -= 1
            metrics.log_if_due()
        metrics.finish()
        collector.shutdown()
        # Before anything else that may fail or be interrupted.
        folder.save_checkpoint(actor=actor, loss=loss, optimizer=optimizer)

        # Evaluation
        watched: dict[bool, EpisodeCollector] = {}
        if watch is not None:
            watched[watch.deterministic] = EpisodeCollector(first_episodes(watch, judgment))
        results = _evaluations(config, actor, judgment, watched)
        summary = {
            **_results(metrics, results, score),
            "steps": metrics.frames,
            "seconds": time.perf_counter() - started,
            "flow": type(flow_head(actor).flow).__name__,
            "order": list(config.flow.order),
            "seed": config.seed,
        }
        folder.save_summary(summary)
        # When the results are kept: a stream that fails takes nothing with it.
        for shown in watched.values():
            for episode in shown.episodes.values():
                watcher.see_episode(episode)
    return summary


def _evaluations(
    config: DictConfig,
    actor: SafeProbabilisticTensorDictSequential,
    settings: EvaluationSettings,
    watched: Mapping[bool, EpisodeCollector],
) -> dict[str, Evaluation]:
    """Evaluate the stochastic policy and the deterministic one; collect episodes of the watched."""
    return {
        name: evaluate_seeded(
            build_environment(config, batch_size=[settings.episodes]),
            guarded(actor),
            settings,
            deterministic=deterministic,
            see=watched.get(deterministic),
        )
        for name, deterministic in {"stochastic": False, "deterministic": True}.items()
    }


def _results(
    metrics: Metrics, evaluations: Mapping[str, Evaluation], score: LinearScore | None
) -> dict[str, Any]:
    """Return what the summary says of training and evaluations; violations are of them all."""
    reports = {name: each.report(score) for name, each in evaluations.items()}
    violations = {
        name: count + sum(each.violations[name] for each in evaluations.values())
        for name, count in metrics.violations.items()
    }
    return {
        "return_mean": reports["stochastic"]["return_mean"],
        "score": reports["stochastic"]["score"],
        "violations": violations,
        "training_violations": metrics.violations,
        "evaluation": reports,
    }


def _keep_what_was_asked(folder: RunFolder, config: DictConfig) -> None:
    """Write what Hydra would, who would write it over that of a run whose folder it is."""
    hydra_config = HydraConfig.get()
    asked = {
        "config": config,
        "hydra": {"hydra": hydra_config},
        "overrides": hydra_config.overrides.task,
    }
    place = folder.path / ".hydra"
    place.mkdir(exist_ok=True)
    for name, content in asked.items():
        with whole_file(place / f"{name}.yaml") as file:
            file.write(OmegaConf.to_yaml(content).encode())


@hydra.main(config_path=str(config_directory()), config_name="train", version_base="1.3")
def main(config: DictConfig) -> float | None:
    """Run `train` for a Hydra configuration, draw its figures and print the summary."""
    folder = RunFolder.create(HydraConfig.get().runtime.output_dir)
    _keep_what_was_asked(folder, config)
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
