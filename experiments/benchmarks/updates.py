"""Time SAC updates and whole training against Stable-Baselines3, in one interleaved run.

`python experiments/benchmarks/updates.py [--quick] [--parts update training] [--output FOLDER]`
(`pip install 'cnfp_torchrl[bench]'` for Stable-Baselines3) measures, on one thread, for networks of
width 64 and 256:

- an update on a batch of 256 drawn from a full buffer, of the exact flow, of an unconstrained
  actor, of Stable-Baselines3's unconstrained SAC, and the matrix products of such an update alone;
- whole training in steps a second, 16 agents and half an update a step, after the warm-up: the
  exact flow and the unconstrained actor in `cnfp_torchrl.training`, and Stable-Baselines3's SAC
  with 16 environments of the same task in its vectorized environment; with ``--compiled``, ours
  compiled as well, and the steps after which the time of compiling is paid back.

In a round all take their turn, so that another program's load falls on all of them; of updates the
process's own time on the processor counts, which waiting for one does not prolong. Reported are
medians over rounds of the ratio to Stable-Baselines3 within a round, with the rounds' quartiles.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles
from typing import Any, NamedTuple

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.tasks.point_nav import POINT_NAV_ID
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.training.agent import build_actor, build_environment, build_loss
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.storage import prepare_buffer
from cnfp_torchrl.training.train import train
from cnfp_torchrl.training.update import Update

RESULTS = Path(__file__).resolve().parents[1] / "results"
REFERENCE = "Stable-Baselines3"
PRODUCTS = "matrix products alone"
FLOWS = {"exact flow": "exact", "unconstrained": "unconstrained"}
AGENTS, BATCH, GAMMA, TAU, LEARNING_RATE = 16, 256, 0.95, 0.005, 1e-3
Rounds = dict[str, list[float]]


def composed(flow: str, width: int, *overrides: str) -> DictConfig:
    """Return the configuration of a training run."""
    return compose_config(f"flow={flow}", f"network.hidden=[{width},{width}]", *overrides)


def our_update(flow: str, width: int, *, compiled: bool = False) -> Callable[[], Any]:
    """Return a call that draws a batch and learns from it, as training does."""
    config = composed(flow, width)
    env = build_environment(config)
    actor = build_actor(config, env)
    loss = build_loss(config, env, actor)
    target = instantiate(config.target, _partial_=True)(loss)
    optimizer = instantiate(config.optim, _partial_=True)(loss.parameters())
    buffer = instantiate(config.replay_buffer)
    steps = env.rollout(200, actor, break_when_any_done=False).detach().reshape(-1)
    limit = config.training.constraint_bytes
    buffer.extend(steps.select(*prepare_buffer(buffer, env, actor.in_keys, constraint_bytes=limit)))
    update = Update(loss, optimizer, target, compiled=compiled)
    return lambda: update(buffer.sample())


def reference_model(width: int, learning_starts: int) -> Any:
    """Return Stable-Baselines3's SAC on 16 environments of the same task, set as ours is."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_util import make_vec_env

    return SAC(
        "MlpPolicy",
        make_vec_env(POINT_NAV_ID, n_envs=AGENTS, seed=0),
        learning_rate=LEARNING_RATE,
        batch_size=BATCH,
        gamma=GAMMA,
        tau=TAU,
        train_freq=1,
        gradient_steps=AGENTS // 2,
        learning_starts=learning_starts,
        target_entropy=-4.0,
        policy_kwargs={"net_arch": [width, width]},
        device="cpu",
        seed=0,
    )


def reference_update(width: int) -> Callable[[], Any]:
    """Return Stable-Baselines3's update, its batch drawn from a buffer of as many transitions."""
    steps = 200 * AGENTS
    model = reference_model(width, learning_starts=2 * steps)
    model.learn(steps)
    return lambda: model.train(gradient_steps=1, batch_size=BATCH)


def matrix_products(width: int) -> Callable[[], None]:
    """Return the matrix products that no SAC update can do without, forwards and backwards.

    The actor on states and next states, the critics on what was done and on what the actor does,
    the target critics on what it does next; gradients of the actor's and the critics' weights, and
    through the critics to the action.
    """
    actor = _layers(5, 4, width)
    critics = [_layers(7, 1, width) for _ in range(2)]
    states, pairs = torch.randn(BATCH, 5), torch.randn(BATCH, 7)

    def forward(layers: list[Tensor], x: Tensor) -> list[Tensor]:
        inputs = []
        for weight in layers:
            inputs.append(x)
            x = x @ weight
        return [*inputs, x]

    def backward(layers: list[Tensor], passed: list[Tensor], *, weights: bool, last: bool) -> None:
        gradient = passed[-1]
        for weight, x in zip(reversed(layers), reversed(passed[:-1]), strict=True):
            if weights:
                _ = x.mT @ gradient
            if last or weight is not layers[0]:
                gradient = gradient @ weight.mT

    @torch.no_grad()
    def products() -> None:
        forward(actor, states)
        for critic in critics:
            forward(critic, pairs)  # targets
            backward(critic, forward(critic, pairs), weights=True, last=False)
            backward(critic, forward(critic, pairs), weights=False, last=True)
        backward(actor, forward(actor, states), weights=True, last=False)

    return products


def _layers(inputs: int, outputs: int, width: int) -> list[Tensor]:
    sizes = [inputs, width, width, outputs]
    return [torch.randn(a, b) / a**0.5 for a, b in pairwise(sizes)]


def time_updates(width: int, rounds: int, repeats: int, *, compiled: bool) -> Rounds:
    """Return the milliseconds of an update of each kind in each round."""
    calls = {name: our_update(flow, width) for name, flow in FLOWS.items()}
    calls |= {REFERENCE: reference_update(width), PRODUCTS: matrix_products(width)}
    if compiled:
        calls |= {f"{n}, compiled": our_update(f, width, compiled=True) for n, f in FLOWS.items()}
    for call in calls.values():
        for _ in range(3):
            call()
    times: Rounds = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            started = time.process_time()
            for _ in range(repeats):
                call()
            times[name].append((time.process_time() - started) / repeats * 1e3)
    return times


class Run(NamedTuple):
    """The speed of a training run once it is under way, and the time that it took until then."""

    steps_per_second: float
    seconds_before: float


def our_training(flow: str, width: int, warmup: int, frames: int, *, compiled: bool) -> Run:
    """Return the time of a run from twice its warm-up on, evaluation apart.

    By then all has been compiled: updates at the end of the warm-up, the policy at the next step.
    """
    with tempfile.TemporaryDirectory() as folder:
        config = composed(
            flow,
            width,
            f"training.warmup_frames={warmup}",
            f"training.log_interval={warmup}",
            f"collector.total_frames={2 * warmup + frames}",
            "evaluation.episodes=1",
            "+env.base.max_steps=100",
            "logger=csv",
            "figures=none",
            f"compile={str(compiled).lower()}",
        )
        path = Path(folder) / "run"
        train(config, RunFolder.create(path))
        with (path / "metrics" / "scalars" / "train" / "seconds.csv").open() as file:
            rows = [(int(step), float(seconds)) for step, seconds in csv.reader(file)]
    # An entry comes after its last step, and after that step's updates.
    (first, started), (last, ended) = next(row for row in rows if row[0] >= 2 * warmup), rows[-1]
    return Run((last - first) / (ended - started), started)


def reference_training(width: int, warmup: int, frames: int) -> float:
    """Return the steps a second of Stable-Baselines3 after its warm-up."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Clock(BaseCallback):
        started: tuple[int, float] | None = None

        def _on_step(self) -> bool:
            if self.started is None and self.num_timesteps > warmup:
                self.started = self.num_timesteps, time.perf_counter()
            return True

    clock, model = Clock(), reference_model(width, learning_starts=warmup)
    model.learn(warmup + frames, callback=clock)
    assert clock.started is not None
    first, started = clock.started
    return (model.num_timesteps - first) / (time.perf_counter() - started)


def time_training(
    width: int, rounds: int, warmup: int, frames: int, *, compiled: bool
) -> tuple[Rounds, dict[str, float]]:
    """Return the steps a second of each kind of training in each round, and seconds of compiling.

    Those are of the first round, in which nothing has been compiled before: the time until a
    compiled run is under way, less that of an eager one.
    """
    speeds: Rounds = {}
    compiling: dict[str, float] = {}
    # What was compiled before would not be compiled now.
    torch.compiler.reset()
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp()
    for _ in range(rounds):
        for name, flow in FLOWS.items():
            eager = our_training(flow, width, warmup, frames, compiled=False)
            speeds.setdefault(name, []).append(eager.steps_per_second)
            if compiled:
                torch.compiler.reset()
                run = our_training(flow, width, warmup, frames, compiled=True)
                speeds.setdefault(f"{name}, compiled", []).append(run.steps_per_second)
                compiling.setdefault(name, run.seconds_before - eager.seconds_before)
        speeds.setdefault(REFERENCE, []).append(reference_training(width, warmup, frames))
    return speeds, compiling


def payback(measured: Rounds, compiling: dict[str, float]) -> list[str]:
    """Return by how many steps compiled training has made up for compiling, in sentences."""
    sentences = []
    for name, seconds in compiling.items():
        eager, compiled = median(measured[name]), median(measured[f"{name}, compiled"])
        steps = seconds / (1 / eager - 1 / compiled)
        end = f"is paid back after {steps:,.0f} steps" if steps > 0 else "is never paid back"
        sentences.append(f"Compiling the {name} took {seconds:.0f} s, which {end}.")
    return sentences


def summary(measured: Rounds) -> dict[str, dict[str, float]]:
    """Return median, and ratio to Stable-Baselines3 with quartiles, of each kind."""
    rows = {}
    for name, values in measured.items():
        ratios = [a / b for a, b in zip(values, measured[REFERENCE], strict=True)]
        low, middle, high = quantiles(ratios, n=4, method="inclusive")
        rows[name] = {"median": median(values), "ratio": middle, "low": low, "high": high}
    return rows


def table(rows: dict[str, dict[str, float]], unit: str) -> str:
    """Return the rows of one width as a Markdown table."""
    cells = [["", unit, f"/ {REFERENCE}", "quartiles"]]
    for name, row in rows.items():
        spread = f"{row['low']:.2f} to {row['high']:.2f}"
        cells.append([name, f"{row['median']:.2f}", f"{row['ratio']:.2f}", spread])
    return markdown_table(cells)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="few rounds, for a test")
    parser.add_argument("--parts", nargs="+", default=["update", "training"])
    parser.add_argument("--widths", type=int, nargs="+", default=[64, 256])
    parser.add_argument("--rounds", type=int, default=7, help="of training; updates take 9 times")
    parser.add_argument("--frames", type=int, default=1600, help="steps of a training run")
    parser.add_argument("--compiled", action="store_true", help="also compiled ones: minutes")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    widths, rounds, repeats, frames = arguments.widths, arguments.rounds, 10, arguments.frames
    if arguments.quick:
        widths, rounds, repeats, frames = [8], 2, 1, 2 * AGENTS
    results: dict[str, dict[str, Any]] = {}
    load = {"before": os.getloadavg()}

    def keep(title: str, unit: str, measured: Rounds, remarks: Sequence[str] = ()) -> None:
        # After each part: what was measured is not lost when the next one is interrupted.
        count = len(measured[REFERENCE])
        rows = summary(measured)
        results[title] = {"unit": unit, "rounds": count, "rows": rows, "remarks": list(remarks)}
        load[f"after {title}"] = os.getloadavg()
        write(arguments.output, results, load)

    for part in arguments.parts:
        for width in widths:
            if part == "update":
                times = time_updates(width, 9 * rounds, repeats, compiled=arguments.compiled)
                keep(f"update, batch {BATCH}, width {width}", "ms", times)
            else:
                speeds, compiling = time_training(
                    width, rounds, 10 * AGENTS, frames, compiled=arguments.compiled
                )
                title = f"training, {AGENTS} agents, width {width}"
                keep(title, "steps/s", speeds, payback(speeds, compiling))
    print((arguments.output / "updates.md").read_text())


def write(folder: Path, results: dict[str, dict[str, Any]], load: dict[str, Any]) -> None:
    """Write results, versions and the machine's load to ``updates.json`` and ``updates.md``."""
    packages = ("cnfp_torchrl", "torch", "torchrl", "tensordict", "stable-baselines3")
    about = {
        "command": f"python experiments/benchmarks/updates.py {' '.join(sys.argv[1:])}".rstrip(),
        "python": platform.python_version(),
        "processor": f"{platform.machine()}, {os.cpu_count()} cores, 1 thread",
        **{name: version(name) for name in packages},
        "load over 1, 5 and 15 minutes": load,
    }
    folder.mkdir(parents=True, exist_ok=True)
    document = {"about": about, "results": results}
    (folder / "updates.json").write_text(json.dumps(document, indent=1) + "\n")
    lines = ["# Updates and training beside Stable-Baselines3", ""]
    lines += [f"- {key}: {value}" for key, value in about.items()] + [""]
    lines += [
        "Medians over rounds in which all take turns; the ratio is taken within a round. Of times "
        "less is better, of steps a second more."
    ]
    for title, result in results.items():
        lines += ["", f"## {title} ({result['rounds']} rounds)", ""]
        lines.append(table(result["rows"], result["unit"]))
        lines += [line for remark in result["remarks"] for line in ("", remark)]
    (folder / "updates.md").write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
