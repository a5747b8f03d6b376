"""Do one run and keep its record; `experiments.field.run` starts many of these.

python -m experiments.field.single_run TASK METHOD SEED [--data FOLDER] [key=value ...]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.bijectors import BoxSquash
from cnfp_torchrl.modules import ConstraintPublisher, flow_head
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.evaluation import Evaluation, evaluate_seeded
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings
from cnfp_torchrl.training.train import train
from experiments.field.curve import CURVE
from experiments.field.jobs import DATA, PEER, Job
from experiments.field.records import Outcome, Record, about

MOVED = 1e-3
"""The change in a component from which an action counts as moved."""

Act = Callable[[TensorDictBase, bool], tuple[Tensor, Tensor]]
"""``(states, greedy) -> (actions, the same before the constraints)``."""


def do(job: Job, overrides: tuple[str, ...]) -> Record:
    """Train, evaluate and return the record."""
    started = time.perf_counter()
    config = job.config(overrides)
    torch.set_num_threads(1)
    if job.method == PEER:
        from experiments.field.peer import train_peer

        act, trained = train_peer(config)
    else:
        act, trained = train_ours(config)
    greedy, stochastic = (evaluate(config, act, greedy=greedy) for greedy in (True, False))
    return Record(
        task=job.task,
        method=job.method,
        seed=job.seed,
        overrides=list(overrides),
        about=about(str(config.get("device") or "cpu")),
        milliseconds=milliseconds(config, act),
        greedy=greedy,
        stochastic=stochastic,
        seconds=round(time.perf_counter() - started, 1),
        **trained,
    )


def train_ours(config: DictConfig) -> tuple[Act, dict[str, Any]]:
    """Train in `cnfp_torchrl.training`; return what acts, and entries of the record."""
    callback = {
        "_target_": "experiments.field.curve.CurveCallback",
        "warmup": config.training.warmup_frames,
    }
    short = {**config, "visual": callback, "evaluation": {**config.evaluation, "episodes": 1}}
    with tempfile.TemporaryDirectory() as path:
        folder = RunFolder.create(path)
        summary = train(DictConfig(short), folder)
        curve = json.loads((folder.path / CURVE).read_text())
        env = build_environment(config, batch_size=[1])
        actor = load_actor(folder, config, env)
    head = flow_head(actor)
    squash = BoxSquash(head.bounds.low, head.bounds.high)

    def act(states: TensorDictBase, greedy: bool) -> tuple[Tensor, Tensor]:
        actor[:-1](states)
        latent = states["loc"]
        if not greedy:
            latent = latent + states["scale"] * torch.randn_like(latent)
        return head.get_bijector(states)(latent), squash(latent)

    updates = int((curve["steps"] - config.training.warmup_frames) * config.training.update_ratio)
    drawn = 2 * updates * config.replay_buffer.batch_size
    relaxed = {
        name: sum(n for state, n in counts["steps"].items() if state != "active")
        for name, counts in summary["constraints"].items()
    }
    return act, {
        **curve,
        "projections": curve["steps"] + drawn if not head.flow.has_density else 0,
        "violations": summary["training_violations"],
        "relaxed": {name: count / curve["steps"] for name, count in relaxed.items()},
    }


def evaluate(config: DictConfig, act: Act, *, greedy: bool) -> Outcome:
    """Return what a policy does in the episodes that the evaluation's seed determines."""
    settings = EvaluationSettings(config.evaluation.episodes, config.evaluation.seed)
    env = build_environment(config, batch_size=[settings.episodes])
    moved, taken = 0, 0

    def policy(states: TensorDictBase) -> TensorDictBase:
        nonlocal moved, taken
        action, free = act(states, greedy)
        moved += int(((action - free).abs().amax(-1) > MOVED).sum())
        taken += states.numel()
        return states.set("action", action)

    result: Evaluation = evaluate_seeded(env, policy, settings, deterministic=greedy)
    return Outcome(
        returns=[round(value, 3) for value in result.returns.tolist()],
        steps=result.steps,
        violations=dict(zip(result.violations, result.costs.sum(0).long().tolist(), strict=True)),
        moved=round(moved / taken, 5),
    )


@torch.no_grad()
def milliseconds(config: DictConfig, act: Act, repeats: int = 100) -> float:
    """Return the median time of an action in a single state, from the observation on."""
    env = build_environment(config, batch_size=[1])
    env.set_seed(0)
    publishers: list[Any] = [
        transform for transform in env.transform if isinstance(transform, ConstraintPublisher)
    ]
    state, times = env.reset(), []
    for _ in range(repeats):
        started = time.perf_counter()
        for publisher in publishers:
            publisher._call(state)
        action, _ = act(state, False)
        times.append(time.perf_counter() - started)
        _, state = env.step_and_maybe_reset(state.set("action", action))
    return round(1e3 * median(times), 4)


def main() -> None:
    """Do the run that the command line names, unless it has a record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("task")
    parser.add_argument("method")
    parser.add_argument("seed", type=int)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    parser.add_argument("overrides", nargs="*", help="of the training configuration, key=value")
    arguments = parser.parse_intermixed_args()
    job = Job(arguments.task, arguments.method, arguments.seed)
    path = job.path(arguments.data)
    if not path.exists():
        do(job, tuple(arguments.overrides)).save(path)


if __name__ == "__main__":
    main()
