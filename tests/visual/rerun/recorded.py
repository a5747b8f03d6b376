"""Recordings of made-up steps, their content read back, and a server that shows them."""

import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import rerun as rr
import torch
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from tensordict import TensorDictBase

from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.rerun import FlowStream, flow_blueprint
from cnfp_torchrl.visual.rerun.follow import is_listening
from cnfp_torchrl.visual.rerun.viewers import LOOPBACK, executable, free_port
from tests.visual.cases import make_actor, make_state

RERUN = executable()


@contextmanager
def recorded(path: Path) -> Iterator[rr.RecordingStream]:
    """Record into a file, which is closed at the end."""
    # In portions of a given size: by the clock, a busy machine would cut elsewhere.
    portions = rr.ChunkBatcherConfig.NEVER()
    portions.flush_num_bytes = 1 << 16
    stream = rr.RecordingStream(
        "tests", recording_id="tests", send_properties=False, batcher_config=portions
    )
    stream.save(path)
    yield stream
    stream.flush(timeout_sec=10)
    stream.disconnect()


def record_steps(
    path: Path,
    sets: Mapping[str, ConstraintSet],
    flow: str = "exact",
    *,
    dim: int = 2,
    steps: int = 2,
    projections: list[tuple[int, int]] | None = None,
) -> list[TensorDictBase]:
    """Stream a policy in one state and return its steps."""
    actor = make_actor(sets, flow, dim=dim, loc=torch.full((dim,), 0.2))
    state = make_state(sets, dim)
    taken = []
    for step in range(steps):
        transition = actor(state.clone())
        transition["next", "reward"] = torch.tensor([float(step)])
        taken.append(transition)
    assert flow_head(actor).order == list(sets)

    with recorded(path) as stream:
        stream.send_blueprint(flow_blueprint(actor, projections=projections))
        flow_stream = FlowStream(stream, actor, projections=projections, samples=64)
        for step, transition in enumerate(taken):
            flow_stream.log_step(step, transition)
    return taken


def read(
    path: Path, entity: str, component: str, timeline: str = "env_step"
) -> dict[int, NDArray[np.float64]]:
    """Return a component of an entity by a timeline's step, as arrays; -1 for what is static.

    Lines of different lengths become an array of arrays.
    """
    found = {}
    for chunk in RrdReader(str(path)).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        values = batch.column(component).to_pylist()
        timelines = [n for n in batch.schema.names if n == "env_step" or n.startswith("episode_")]
        if timelines and timeline not in timelines:
            continue
        steps = batch.column(timeline).to_pylist() if timelines else [-1] * len(values)
        for step, value in zip(steps, values, strict=True):
            found[step] = np.array(value, dtype=object if _is_ragged(value) else None)
    return found


def _is_ragged(value: list[object]) -> bool:
    return len({len(row) for row in value if isinstance(row, list)}) > 1


def compare(one: Path, other: Path) -> subprocess.CompletedProcess[str]:
    """Compare two recordings by Rerun's own command."""
    return subprocess.run(
        [RERUN, "rrd", "compare", str(one), str(other)], capture_output=True, text=True, check=False
    )


@contextmanager
def viewer_server() -> Iterator[tuple[int, psutil.Popen]]:
    """Start a viewer's server, the real program without its window; give its port and process."""
    port = free_port()
    command = [RERUN, "--serve-grpc", "--bind", LOOPBACK, "--port", str(port)]
    server = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not is_listening((LOOPBACK, port)):
            assert server.poll() is None
            time.sleep(0.05)
        yield port, server
    finally:
        server.kill()
        server.wait()
