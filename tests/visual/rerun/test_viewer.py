"""The recording in the real viewer, without a window: what a person would see of it."""

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from rerun.experimental import ViewerClient, ViewerState

from cnfp_torchrl import constrain_env
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual.rerun import TRAINING_PLOTS, FlowStream, RerunLogger, flow_blueprint
from tests.visual.cases import LINE, SPACE, Gaussian
from tests.visual.rerun.recorded import RERUN, record_steps, recorded

DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
pytestmark = pytest.mark.skipif(
    not any(list(Path(folder).glob("*.json")) for folder in DRIVERS if Path(folder).is_dir()),
    reason="no Vulkan driver; on Debian: apt-get install mesa-vulkan-drivers",
)
PATIENCE_S = 60.0
STEPS = 4


@pytest.fixture
def viewer() -> Iterator[ViewerClient]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with ViewerClient.spawn(
        headless=True,
        port=port,
        executable_path=RERUN,
        hide_welcome_screen=True,
        memory_limit="1GB",
    ) as client:
        yield client


def opened(viewer: ViewerClient, path: Path, last: int) -> list:
    """Open a recording, wait until it is there to its last step, and return its views."""
    viewer.open(str(path))
    ends = time.monotonic() + PATIENCE_S
    before: list[str] = []
    while time.monotonic() < ends:
        state = viewer.get_state()
        timelines = [
            timeline
            for recording in state.recordings
            if recording.store_id == state.active_recording
            for timeline in recording.timelines
        ]
        # The views get other identifiers when the viewer makes the recording's layout its own.
        now = [view.view_id for view in state.views]
        is_settled, before = bool(now) and now == before, now
        if not state.loading and is_settled and any(t.end == last for t in timelines):
            return state.views
        time.sleep(0.5)
    raise AssertionError(f"the viewer did not show {path} up to step {last}: {viewer.get_state()}")


def current_times(state: ViewerState) -> list[int | None]:
    return [r.current_time for r in state.recordings if r.store_id == state.active_recording]


def picture(viewer: ViewerClient, view_id: str, step: int) -> bytes:
    """Go to a step and return what a view shows there, once it has settled."""
    viewer.set_time("env_step", sequence=step, play_state="paused")
    ends = time.monotonic() + PATIENCE_S
    before = b""
    while time.monotonic() < ends:
        # On a busy machine the viewer's own time to answer, 15 s, may be over.
        with suppress(TimeoutError):
            state = viewer.get_state()
            now = viewer.take_screenshot(view_id) if step in current_times(state) else b""
            if now and now == before:
                return now
            before = now
        time.sleep(0.2)
    raise AssertionError(f"view {view_id} does not settle at step {step}")


def test_point_navigation(viewer: ViewerClient, tmp_path: Path) -> None:
    env = constrain_env(PointNavEnv([1], seed=0), BatteryGeometry(), ObstacleGeometry())
    actor = make_constrained_actor(Gaussian(torch.zeros(2), torch.ones(2)), env)
    rollout = env.rollout(STEPS, actor)[0]
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        stream.send_blueprint(flow_blueprint(actor, env, training=TRAINING_PLOTS))
        logger = RerunLogger("run", stream=stream)
        flow_stream = FlowStream(stream, actor, env)
        for step, transition in enumerate(rollout):
            flow_stream.log_step(step, transition)
            for name in ("train/return", "loss/actor", "train/alpha", "train/entropy"):
                logger.log_scalar(name, float(step), step=step)
            for name in ("battery", "obstacle"):
                logger.log_scalar(f"violations/{name}", 0.0, step=step)
                logger.log_scalar(f"evaluation/violations/{name}", 0.0, step=step)
    views = opened(viewer, path, STEPS - 1)
    assert sorted(view.name for view in views) == sorted(
        [
            "Map",
            "Legend",
            "1 · action bounds",
            "2 · battery",
            "3 · obstacle, highest priority",
            "What happened in this step",
            "Moved by (action units)",
            "Allowed before the flow (% of samples)",
            "Relaxed by (action units)",
            "Violations so far (steps)",
            "Entropy (nats)",
            "Reward of a step",
            "Return so far",
            "Battery (%)",
            "Executed action",
            "Observation",
            *TRAINING_PLOTS,
        ]
    )
    assert not [report for view in views for report in view.reports]
    by_name = {view.name: view.view_id for view in views}
    for name in ("Map", "3 · obstacle, highest priority"):
        first, last = (picture(viewer, by_name[name], step) for step in (0, STEPS - 1))
        assert first != last
    assert picture(viewer, by_name[name], 0) == first


@pytest.mark.parametrize(("case", "stages"), [("line", 3), ("space", 6)])
def test_other_environments_have_no_map(
    case: str, stages: int, viewer: ViewerClient, tmp_path: Path
) -> None:
    path = tmp_path / "recording.rrd"
    if case == "line":
        record_steps(path, LINE, dim=1, steps=2)
    else:
        record_steps(path, SPACE, dim=3, steps=2, projections=[(0, 1), (1, 2)])
    views = opened(viewer, path, 1)
    assert not [report for view in views for report in view.reports]
    names = [view.name for view in views]
    assert sum(name[0].isdigit() for name in names) == stages
    assert "Map" not in names
    stage = next(view.view_id for view in views if view.name.startswith("3"))
    assert picture(viewer, stage, 0) != picture(viewer, stage, 1)
