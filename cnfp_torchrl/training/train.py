"""Training of a policy that cannot break its constraints, and its evaluation."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.checkpoint import GlobalRNGState
from torchrl.envs import TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.configuration import require_settings
from cnfp_torchrl.modules import flow_head, guarded
from cnfp_torchrl.training.agent import (
    build_actor,
    build_environment,
    training_environment,
)
from cnfp_torchrl.training.callbacks import (
    RECORDING,
    CallbackFactory,
    NoCallback,
    TrainingCallback,
    give_episodes,
)
from cnfp_torchrl.training.checkpoints import Attributes
from cnfp_torchrl.training.collectors import make_collector, shutting_down
from cnfp_torchrl.training.constraint_counts import (
    ConstraintTally,
    constraint_reports,
    violations_of,
)
from cnfp_torchrl.training.environment_state import CollectorState, EpisodesBeginAnewWarning
from cnfp_torchrl.training.evaluation import Evaluation, LinearScore, evaluate_seeded
from cnfp_torchrl.training.interruption import (
    STOP_SIGNALS,
    StopRequest,
    TrainingInterrupted,
    starting_workers,
)
from cnfp_torchrl.training.interval_evaluation import IntervalEvaluation
from cnfp_torchrl.training.learner import Learner
from cnfp_torchrl.training.metrics import Metrics
from cnfp_torchrl.training.observation_scale import warn_of_large_observations
from cnfp_torchrl.training.provenance import provenance
from cnfp_torchrl.training.run_folder import STATES, RunFolder
from cnfp_torchrl.training.run_state import BestPolicy, RunState
from cnfp_torchrl.training.settings import (
    CheckpointSettings,
    EvaluationSettings,
    TrainingSettings,
    require_frames,
)

_log = logging.getLogger(__name__)


def train(config: DictConfig, folder: RunFolder, *, resume: bool = False) -> dict[str, Any]:
    """Train, evaluate and leave everything in the run's folder.

    Args:
        config: The configuration as composed from ``conf/train.yaml``.
        folder: An empty run folder, or that of a run to go on with.
        resume: Whether to go on where the run in the folder was saved last.

    Returns:
        The summary that is also written to ``summary.json``.

    Raises:
        ValueError: before any work, for a setting that makes no sense.
        CheckpointError: when the state of the run cannot be written or read, or a log not written.
        TrainingInterrupted: when SIGTERM or Ctrl-C came and the state is saved, or came twice.
    """
    with closing(folder), folder.naming_what_cannot_be_written():
        return _train(config, folder, resume)


def _train(config: DictConfig, folder: RunFolder, resume: bool) -> dict[str, Any]:
    # Settings
    require_settings(config)
    require_frames(config)
    settings: TrainingSettings = instantiate(config.training)
    saving: CheckpointSettings = instantiate(config.checkpoint)
    evaluation: EvaluationSettings = instantiate(config.evaluation)
    score: LinearScore | None = instantiate(config.env.get("score"))
    visual: CallbackFactory | None = instantiate(config.visual, _convert_="all") or None
    torch.manual_seed(config.seed)
    torch.set_num_threads(config.threads)

    # Environment, actor, algorithm and collector
    is_saved = saving.interval is not None
    with starting_workers():  # such as those of a ParallelEnv
        env = training_environment(config)
        env.set_seed(config.seed)
        warn_of_large_observations(config, env)
        tally = ConstraintTally.of(env)
        actor = build_actor(config, env)
        learner: Learner = instantiate(config.algorithm, _partial_=True)(
            config, env, actor, folder.path / STATES if is_saved else None
        )
        collector = make_collector(config, env, learner.policy)
    learner.begin()

    # Callback and loggers
    state = RunState(folder, saving)
    if resume:
        done = state.load()
        _require_steps_to_go(config, folder, done)
        state.drop_what_came_after()
        folder.replace_config(config)
    _log.info(
        "training for %s steps, then twice %s episodes of at most %s steps each",
        config.collector.total_frames,
        evaluation.episodes,
        evaluation.max_steps,
    )
    callback: TrainingCallback = NoCallback()
    if visual is not None:
        recording = folder.new_file(RECORDING) if resume else folder.path / RECORDING
        callback = visual.for_training(recording, actor, env)
    if not resume:
        folder.save_config(config)
    loggers = [
        make(log_dir=str(folder.path)) for make in (instantiate(config.logger) or {}).values()
    ]
    metrics = Metrics(
        [*loggers, *callback.loggers],
        tally,
        total_frames=config.collector.total_frames,
        interval=settings.log_interval,
    )

    # What the run goes on from
    trained = {"actor": actor, "loss": learner.loss, "optimizer": learner.optimizer}
    best = BestPolicy(folder, **trained)
    episodes = CollectorState(collector, env)
    evaluations = IntervalEvaluation(
        partial(_evaluation_environment, config, evaluation.at_interval().episodes),
        actor,
        evaluation,
        score,
    )
    state.restore(
        {
            **trained,
            **learner.components(),
            "best": Attributes(best, "score", "violations"),
            "evaluations": Attributes(evaluations, "history"),
            "metrics": metrics,
            "collector": episodes,
            "random": GlobalRNGState(),
        },
        learner.transitions,
    )
    if resume:
        callback.continue_at(metrics.frames)
        sys.stderr.write(f"{folder.path}: goes on at step {done}\n")
        if done and (reason := episodes.why_episodes_begin_anew):
            warnings.warn(
                f"the episodes that ran at step {done} begin anew: {reason}",
                EpisodesBeginAnewWarning,
                stacklevel=3,
            )

    def evaluate_if_due(is_last: bool) -> None:
        if (report := evaluations.run_if_due(metrics.frames, is_last)) is not None:
            metrics.add_evaluation(report)
            best.offer_evaluation(report)

    with closing(callback), closing(evaluations):
        with StopRequest(folder.how_to_resume(), STOP_SIGNALS if is_saved else ()) as stop:
            with closing(metrics), shutting_down(collector):
                for collected in collector:
                    callback.on_batch(collected)
                    metrics.add_steps(collected.reshape(-1))
                    for losses in learner.learn(collected, metrics.frames):
                        metrics.add_losses(losses)
                    metrics.log_if_due()
                    is_last = metrics.frames >= config.collector.total_frames
                    evaluate_if_due(is_last=False)
                    if is_last or stop.signal is not None or state.is_due(metrics.frames):
                        if evaluation.interval is None:
                            best.offer(*_training_score(metrics, score))
                        state.save(metrics.frames)
                    if stop.signal is not None:
                        raise TrainingInterrupted(stop.signal, folder.how_to_resume(metrics.frames))
                # Behind the last state, so that an extended run is as one that was longer at once.
                evaluate_if_due(is_last=True)
                metrics.finish()
            # Before anything else that may fail or be interrupted.
            folder.save_checkpoint(**trained)

            # Evaluation
            with stop.ending_at_once(folder.how_to_resume(metrics.frames)):
                summary = {
                    **_results(metrics, _evaluations(config, actor, evaluation), score),
                    "evaluations_in_training": evaluations.history,
                    "steps": metrics.frames,
                    "seconds": metrics.seconds,
                    "flow": type(flow_head(actor).flow).__name__,
                    "order": flow_head(actor).order,
                    "seed": config.seed,
                    **provenance(config.device),
                }
        folder.save_summary(summary)
        state.finish()
        # When the results are kept: a callback that fails takes nothing with it.
        if visual is not None:
            with closing(
                build_environment(config, batch_size=[1], device=config.device, with_anchor=True)
            ) as single:
                give_episodes(callback, visual, evaluation, single, actor)
    return summary


def _require_steps_to_go(config: DictConfig, folder: RunFolder, done: int) -> None:
    """Refuse to go on with a finished run that is not extended, or whose states are gone."""
    if not folder.is_finished:
        return
    if not done:
        raise ValueError(
            f"resume: expected a run with states to go on from, but {folder.path / STATES} of this "
            "finished one has none; train again with checkpoint.keep_last=true"
        )
    if done >= config.collector.total_frames:
        raise ValueError(
            f"resume: expected a run that was stopped, given {folder.path}, which has finished "
            f"with {done} steps; to extend it, add collector.total_frames=N with more of them"
        )


def _training_score(metrics: Metrics, score: LinearScore | None) -> tuple[float, int]:
    """Return the score of the last episodes of training, and all violations so far."""
    violations = sum(count or 0 for count in violations_of(metrics.counts()).values())
    last = metrics.last_return
    return last if score is None else score(last), violations


def _evaluation_environment(config: DictConfig, episodes: int) -> TransformedEnv:
    """Return an environment for some episodes, without a penalty, on the device of training."""
    with starting_workers():
        env = build_environment(config, batch_size=[episodes], device=config.device)
        env.reset()  # which is when those of a ParallelEnv start
        return env


def _evaluations(
    config: DictConfig,
    actor: SafeProbabilisticTensorDictSequential,
    settings: EvaluationSettings,
) -> dict[str, Evaluation]:
    """Evaluate the stochastic policy and the deterministic one.

    Args:
        config: That of the run.
        actor: The trained actor.
        settings: The number of episodes and the seed.
    """
    with closing(_evaluation_environment(config, settings.episodes)) as env:
        return {
            name: evaluate_seeded(env, guarded(actor), settings, deterministic=deterministic)
            for name, deterministic in {"stochastic": False, "deterministic": True}.items()
        }


def _results(
    metrics: Metrics, evaluations: Mapping[str, Evaluation], score: LinearScore | None
) -> dict[str, Any]:
    """Return what the summary says of training and evaluations; counts are of them all."""
    reports = {name: result.report(score) for name, result in evaluations.items()}
    counts = dict(training := metrics.counts())
    for result in evaluations.values():
        counts = {name: count + result.constraints[name] for name, count in counts.items()}
    return {
        "return_mean": reports["stochastic"]["return_mean"],
        "score": reports["stochastic"]["score"],
        "violations": violations_of(counts),
        "training_violations": violations_of(training),
        "constraints": constraint_reports(counts),
        "evaluation": reports,
    }
