"""Picture a trained run's stream in the viewer: `python experiments/figures/stream.py RUN FOLDER`.

Takes the episode in which the constraints move the executed actions most, opens its recording in a
viewer without a window (which needs a Vulkan driver; Mesa's for the processor will do), and writes
``stream.png``, the most telling step, and ``stream.webp``, the steps around it.
"""

from __future__ import annotations

import argparse
import io
import socket
import tempfile
import time
from pathlib import Path

import rerun as rr
import torch
from PIL import Image
from rerun.experimental import ViewerClient
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual import replay_step
from cnfp_torchrl.visual.rerun import FlowStream, flow_blueprint
from cnfp_torchrl.visual.rerun.viewers import executable

EPISODES, FRAMES = 16, 40
NOTICES_S = 12.0
"""The viewer's notices at its start cover a corner for so long."""
BAR = 36
"""Height in pixels of the viewer's empty title bar."""
WIDTH, FILM_WIDTH = 1600, 1200
PATIENCE_S = 30.0


def moved(actor: SafeProbabilisticTensorDictSequential, episode: list[TensorDictBase]) -> Tensor:
    """Return by how much each constraint moved the executed action, ``(steps, K)``."""
    noise = torch.zeros(1, 2)
    paths = torch.stack([replay_step(actor, step, noise).path() for step in episode])
    return vector_norm(paths.diff(dim=1), dim=-1)


def most_telling(
    actor: SafeProbabilisticTensorDictSequential, episodes: list[list[TensorDictBase]]
) -> tuple[list[TensorDictBase], int]:
    """Return the episode in which every constraint acts most, and where the rarest of them does."""
    ways = torch.stack([moved(actor, episode) for episode in episodes])
    chosen = int(ways.sum(1).amin(-1).argmax())
    rarest = int(ways[chosen].sum(0).argmin())
    return episodes[chosen], int(ways[chosen, :, rarest].argmax())


def screenshot(viewer: ViewerClient, step: int) -> Image.Image:
    """Return what the viewer shows of a step, once it has settled."""
    viewer.set_time("env_step", sequence=step, play_state="paused")
    before, ends = b"", time.monotonic() + PATIENCE_S
    while (now := viewer.take_screenshot()) != before:
        if time.monotonic() > ends:
            raise TimeoutError(f"the viewer does not settle at step {step}")
        before = now
        time.sleep(0.15)
    picture = Image.open(io.BytesIO(now)).convert("RGB")
    return picture.crop((0, BAR, *picture.size))


def resized(picture: Image.Image, width: int) -> Image.Image:
    """Return a picture of a width, in proportion."""
    height = round(picture.height * width / picture.width)
    return picture.resize((width, height), Image.Resampling.LANCZOS)


def main() -> None:
    """Record, open, look, and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run on point navigation")
    parser.add_argument("output", type=Path, help="folder of the pictures")
    arguments = parser.parse_args()

    folder = RunFolder.open(arguments.run)
    config = folder.load_config()
    env = build_environment(config, batch_size=[EPISODES], with_anchor=True)
    actor = load_actor(folder, config, env)
    env.set_seed(0)
    torch.manual_seed(0)
    with torch.no_grad():
        rollout = env.rollout(1000, actor)
    episode, telling = most_telling(actor, [list(recorded.unbind(0)) for recorded in rollout])

    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "episode.rrd"
        recording = rr.RecordingStream("cnfp_torchrl")
        recording.set_sinks(rr.FileSink(path), default_blueprint=flow_blueprint(actor, env))
        stream = FlowStream(recording, actor, env)
        for index, step in enumerate(episode):
            stream.log_step(index, step)
        recording.flush(timeout_sec=30)
        recording.disconnect()

        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        viewer = ViewerClient.spawn(
            headless=True,
            port=port,
            executable_path=executable(),
            hide_welcome_screen=True,
            memory_limit="1GB",
        )
        with viewer:
            viewer.open(str(path))
            time.sleep(NOTICES_S)
            first = max(0, min(telling - FRAMES // 2, len(episode) - FRAMES))
            last = min(first + FRAMES, len(episode))
            pictures = {step: screenshot(viewer, step) for step in range(first, last)}

    arguments.output.mkdir(parents=True, exist_ok=True)
    resized(pictures[telling], WIDTH).save(arguments.output / "stream.png", optimize=True)
    film = [resized(picture, FILM_WIDTH) for picture in pictures.values()]
    film[0].save(
        arguments.output / "stream.webp",
        save_all=True,
        append_images=film[1:],
        duration=300,
        loop=0,
        quality=70,
        method=6,
    )


if __name__ == "__main__":
    main()
