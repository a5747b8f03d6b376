"""Time the stream to Rerun: `python experiments/benchmarks/stream.py [--quick] [--output FOLDER]`.

Measures processor time, of all threads, with everything written to a file: each step of an
evaluation in full detail, and training as the collector's hook sees it, one agent of 16 and each
tenth of its steps. Without a stream
nothing of it is called, so that there is nothing to measure; that Rerun is not even imported then
is measured instead.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import rerun as rr
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl import constrain_env
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.visual.rerun import FlowStream, StreamHook, flow_blueprint

RESULTS = Path(__file__).resolve().parents[1] / "results"
AGENTS = 16
EVERY = 10
EVALUATION, TRAINING = "evaluation, each step", f"training, every {EVERY}th step"
GOALS_MS = {EVALUATION: 10.0, TRAINING: 1.5}

_WHAT_IS_IMPORTED = (
    "import sys, cnfp_torchrl.visual, cnfp_torchrl.training.train; print('rerun' in sys.modules)"
)


class StandardNormal(nn.Module):
    """The base of a network that has learned nothing yet, at almost no cost."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location 0 and scale 1."""
        shape = (*observation.shape[:-1], 2)
        return torch.zeros(shape), torch.ones(shape)


def pipeline() -> tuple[TransformedEnv, SafeProbabilisticTensorDictSequential]:
    """Return point navigation with K = 2 constraints, and an actor for it."""
    env = constrain_env(PointNavEnv([AGENTS], seed=0), BatteryGeometry(), ObstacleGeometry())
    actor = make_constrained_actor(StandardNormal(), env)
    return env, actor


class EachStep:
    """Stream transitions of batch size ``()``, one after another, as evaluations do.

    Args:
        stream: The stream of the policy.
    """

    def __init__(self, stream: FlowStream) -> None:
        self._stream, self._step = stream, 0

    def __call__(self, transition: TensorDictBase) -> None:
        """Stream the next transition."""
        self._stream.log_step(self._step, transition)
        self._step += 1


def processor_time(
    env: TransformedEnv,
    actor: SafeProbabilisticTensorDictSequential,
    steps: Sequence[TensorDictBase],
    every: int,
    way: Callable[[FlowStream], Callable[[TensorDictBase], None]],
) -> tuple[float, float]:
    """Return milliseconds of processor time and bytes of the file, for each step.

    Args:
        env: The environment of point navigation.
        actor: Its policy.
        steps: What the way into the stream takes for a step; the first tenth warms up.
        every: See `FlowStream`.
        way: The way into the stream.
    """
    warm_up = len(steps) // 10
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.rrd"
        recording = rr.RecordingStream("benchmark")
        recording.set_sinks(rr.FileSink(path), default_blueprint=flow_blueprint(actor, env))
        see = way(FlowStream(recording, actor, env, every=every))
        for step in steps[:warm_up]:
            see(step)
        recording.flush(timeout_sec=30)
        size, start = path.stat().st_size, time.process_time()
        for step in steps[warm_up:]:
            see(step)
        recording.flush(timeout_sec=30)
        taken = time.process_time() - start
        size = path.stat().st_size - size
        recording.disconnect()
    measured = len(steps) - warm_up
    return 1000 * taken / measured, size / measured


def reference() -> float:
    """Return the milliseconds of a fixed piece of work, which tell how busy the machine is."""
    start = time.process_time()
    torch.randn(2000, 200, generator=torch.Generator().manual_seed(0)).cumsum(0).exp().sum()
    for _ in range(1_000_000):
        pass
    return 1000 * (time.process_time() - start)


def table(rows: dict[str, dict[str, Any]], setting: dict[str, Any]) -> str:
    """Return the results as Markdown."""
    cells = [
        [
            name,
            f"{statistics.median(row['ms']):.2f}",
            f"{min(row['ms']):.2f} to {max(row['ms']):.2f}",
            str(GOALS_MS[name]),
            f"{row['bytes']:.0f}",
        ]
        for name, row in rows.items()
    ]
    lines = [
        "# What the stream to Rerun costs",
        "",
        "`python experiments/benchmarks/stream.py`",
        "",
        "Processor time of all threads for a step of point navigation (K = 2, 512 samples, three "
        "stages, densities on 40 x 40 cells), written to a file; median and range of "
        f"{setting['repeats']} repeats of {setting['steps']} steps. In training, the collector's "
        f"hook streams one of {AGENTS} agents. One thread of PyTorch "
        f"{setting['torch']}, Rerun {setting['rerun']}, Python {setting['python']} on "
        f"{setting['processor']}.",
        "",
        markdown_table([["", "ms a step", "range", "goal", "bytes a step"], *cells]),
        "",
        f"Without a stream, Rerun is imported: {setting['imported_when_off']}. On a busy machine a "
        f"step costs more: the load was {setting['load']:.1f} on {setting['processors']} "
        f"processors, and a fixed piece of work beside it took {setting['reference_ms']} ms.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write ``stream.json`` and ``stream.md``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few steps, to see that it works")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    steps, repeats = (20, 1) if arguments.quick else (500, 7)

    torch.set_num_threads(1)
    torch.manual_seed(0)
    env, actor = pipeline()
    rollout = env.rollout(steps, actor, break_when_any_done=False)
    measured: dict[str, Callable[[], tuple[float, float]]] = {
        EVALUATION: partial(processor_time, env, actor, rollout[0].unbind(0), 1, EachStep),
        # A collector yields batches (environments, time) of one step, each with its own memory.
        TRAINING: partial(
            processor_time,
            env,
            actor,
            [batch.clone() for batch in rollout.split(1, dim=1)],
            EVERY,
            StreamHook,
        ),
    }
    off = subprocess.run(
        [sys.executable, "-c", _WHAT_IS_IMPORTED], check=True, capture_output=True, text=True
    )
    rows: dict[str, dict[str, Any]] = {name: {"ms": [], "bytes": 0.0} for name in GOALS_MS}
    references = []
    for _ in range(repeats):
        for name, measure in measured.items():
            references.append(reference())
            milliseconds, size = measure()
            rows[name]["ms"].append(milliseconds)
            rows[name]["bytes"] = size
    setting = {
        "steps": steps,
        "repeats": repeats,
        "reference_ms": round(statistics.median(references), 2),
        "load": os.getloadavg()[0],
        "processors": os.cpu_count(),
        "imported_when_off": off.stdout.strip(),
        "python": platform.python_version(),
        "processor": platform.machine(),
        "torch": version("torch"),
        "rerun": version("rerun-sdk"),
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "stream.json").write_text(
        json.dumps({"setting": setting, "rows": rows}, indent=2) + "\n"
    )
    text = table(rows, setting)
    (arguments.output / "stream.md").write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
