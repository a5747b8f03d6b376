"""The stream holds what the policy did, for any flow and any action space."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import torch
from tensordict import TensorDict

from cnfp_torchrl import constrain_env
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual.explanation import explain
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.rerun import FlowStream, open_recording
from cnfp_torchrl.visual.rerun.series import task_plots
from cnfp_torchrl.visual.setting import Setting
from tests.visual.cases import (
    CONFLICT,
    LINE,
    PLANE,
    SPACE,
    Gaussian,
    flows_in_cases,
    make_actor,
    make_snapshot,
    make_state,
)
from tests.visual.rerun.recorded import compare, read, record_steps, recorded


@flows_in_cases("exact", "radial", "squash", "unconstrained")
def test_any_flow_in_any_action_space(
    flow: str, sets: dict[str, ConstraintSet], dim: int, tmp_path: Path
) -> None:
    path = tmp_path / "recording.rrd"
    first_step, second_step = record_steps(path, sets, flow, dim=dim)
    stages = {"squash": list(sets) or ["bounds"], "unconstrained": ["bounds"]}.get(
        flow, ["bounds", *sets]
    )
    for number, name in enumerate(stages, start=1):
        view = f"/stages/{number}\\ {name}" + ("/a1\\,\\ a2" if dim > 2 else "")
        samples = read(path, f"{view}/samples", "Points2D:positions")
        outside = read(path, f"{view}/samples_outside", "Points2D:positions")
        assert sum(len(part.get(0, [])) for part in (samples, outside)) == 64
    executed = read(path, f"{view}/executed", "Points2D:positions")
    shown = min(dim, 2)
    for step, transition in enumerate((first_step, second_step)):
        at = executed[step][-1, :shown]
        np.testing.assert_array_equal(at, transition["action"][:2].numpy())
        assert len(executed[step]) == len(stages) + 1


@pytest.mark.parametrize(
    ("sets", "dim", "view", "titles"),
    [
        (LINE, 1, "3\\ ball", ["→ a1, -1 to 1"]),
        (PLANE, 2, "2\\ battery", ["→ a1, -1 to 1", "↑ a2, -1 to 1"]),
        (SPACE, 3, "1\\ bounds/a2\\,\\ a3", ["→ a2, -1 to 1", "↑ a3, -1 to 1"]),
    ],
)
def test_axes_have_names_and_ends(
    sets: dict[str, ConstraintSet], dim: int, view: str, titles: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "recording.rrd"
    record_steps(path, sets, dim=dim)
    assert read(path, f"/stages/{view}/axes", "Points2D:labels")[-1].tolist() == titles


def test_samples_density_and_explanation_are_the_policys(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    step, _ = record_steps(path, PLANE)
    actor = make_actor(PLANE)
    noise = torch.randn(64, 2, generator=torch.Generator().manual_seed(0))
    snapshot = replay_step(actor, step, noise)
    for number, stage in enumerate(snapshot.stages, start=1):
        view = f"/stages/{number}\\ {stage.name}"
        samples = read(path, f"{view}/samples", "Points2D:positions")[0]
        np.testing.assert_array_equal(samples, stage.samples[1:].numpy())
        heat = read(path, f"{view}/density", "DepthImage:buffer")[0].reshape(40, 40)
        at = (-1 + 2 * (np.arange(40) + 0.5) / 40).astype(np.float32)
        cells = torch.from_numpy(np.stack(np.meshgrid(at, at), axis=-1))
        allowed = torch.ones(40, 40, dtype=torch.bool)
        for index in stage.applied:
            allowed &= snapshot.region.sets[index].contains(cells)
        assert not heat[~allowed.numpy()].any()
        assert heat[allowed.numpy()].mean() > 100
    explanation = read(path, "/explanation", "TextDocument:text")[0]
    assert explanation.item() == explain(snapshot).markdown()


def test_outline_of_the_battery_is_its_ball(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    record_steps(path, PLANE)
    (outline,) = read(path, "/stages/2\\ battery/own_set", "LineStrips2D:strips")[0]
    inside = np.abs(outline).max(-1) < 1.0999
    assert inside.sum() > 100
    ball = PLANE["battery"]
    distances = np.linalg.norm(outline[inside] - ball.center.numpy(), axis=-1)
    np.testing.assert_allclose(distances, float(ball.radius), rtol=1e-6)


def test_point_navigation_has_a_map_and_time_series(tmp_path: Path) -> None:
    env = constrain_env(
        PointNavEnv([2], seed=0, max_steps=3), BatteryGeometry(), ObstacleGeometry()
    )
    actor = make_constrained_actor(Gaussian(torch.zeros(2), torch.ones(2)), env)
    start = env.reset(position=(-0.5, 0.6), battery=30)
    rollout = env.rollout(7, actor, tensordict=start, auto_reset=False, break_when_any_done=False)[
        1
    ]
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        flow_stream = FlowStream(stream, actor, env)
        for step, transition in enumerate(rollout):
            flow_stream.log_step(10 * step, transition)
    reward = rollout["next", "reward"].squeeze(-1).double()
    logged = read(path, "/series/reward", "Scalars:scalars")
    assert {step: value.item() for step, value in logged.items()} == {
        10 * step: value.item() for step, value in enumerate(reward)
    }
    returns = torch.cat([reward[:3].cumsum(0), reward[3:6].cumsum(0), reward[6:]])
    logged = read(path, "/series/return", "Scalars:scalars")
    np.testing.assert_allclose([logged[10 * step].item() for step in range(7)], returns.numpy())
    charge = read(path, "/series/task/battery", "Scalars:scalars")
    np.testing.assert_allclose(charge[20], [100 * rollout["observation"][2, 2].item(), 20])
    assert read(path, "/series/costs", "Scalars:scalars")[60].tolist() == [0, 0]
    place = rollout["observation"][:, :2].double().numpy()
    for step in range(7):
        agent = read(path, "/map/agent", "Points2D:positions")[10 * step]
        np.testing.assert_allclose(agent, [place[step]] * 2, rtol=1e-6)
    (vector,) = read(path, "/map/move", "Arrows2D:vectors")[30]
    np.testing.assert_allclose(vector, 0.1 * rollout["action"][3].double().numpy(), rtol=1e-6)
    # The battery's ball, in arena units around the nearest station.
    anchor = place[2] + 0.1 * rollout["constraints", "battery", "center"][2].double().numpy()
    radius = 0.1 * float(rollout["constraints", "battery", "radius"][2])
    strips = read(path, "/map/sets/1", "LineStrips2D:strips")
    for line in strips[max(step for step in strips if step <= 20)]:
        inner = np.array([point for point in line if max(map(abs, point)) < 0.9999])
        np.testing.assert_allclose(np.linalg.norm(inner - anchor, axis=-1), radius, rtol=1e-4)
    trail = read(path, "/map/trail", "LineStrips2D:strips")
    assert len(trail[20][-1]) == 3
    assert len(trail[40][-1]) == 2  # the episode ended after the third step


def test_every_nth_step_is_logged_and_all_are_counted(tmp_path: Path) -> None:
    actor, state = make_actor(PLANE), make_state(PLANE)
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        flow_stream = FlowStream(stream, actor, every=3, samples=8)
        for step in range(8):
            transition = actor(state.clone())
            transition["next", "reward"] = torch.ones(1)
            flow_stream.log_step(step, transition)
    returns = read(path, "/series/return", "Scalars:scalars")
    assert {step: value.item() for step, value in returns.items()} == {0: 1, 3: 4, 6: 7}
    executed = "/stages/1\\ bounds/executed"
    assert set(read(path, executed, "Points2D:positions")) == {0, 3, 6}


def test_a_second_stream_shows_nothing_of_the_first(tmp_path: Path) -> None:
    actor = make_actor(CONFLICT)
    dropped, kept = make_state(CONFLICT), make_state(CONFLICT | {"far": CONFLICT["near"]})
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        for step, state in enumerate((dropped, kept)):
            FlowStream(stream, actor, samples=8).log_step(step, actor(state))
    lines = read(path, "/stages/2\\ far/own_set_dropped", "LineStrips2D:strips")
    assert len(lines[0]) > 0
    assert len(lines[1]) == 0


def test_a_heading_begins_the_explanation(tmp_path: Path) -> None:
    actor = make_actor(PLANE)
    transition = actor(make_state(PLANE))
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        flow_stream = FlowStream(stream, actor, samples=8)
        flow_stream.log_step(0, transition)
        flow_stream.log_step(1, transition, "The same again")
    words = read(path, "/explanation", "TextDocument:text")
    assert words[1].item() == f"The same again: {words[0].item()}"


def test_projections_are_rows_of_views(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    (step,) = record_steps(path, SPACE, dim=3, steps=1, projections=[(0, 2), (2, 1)])
    action = step["action"].numpy()
    for pair, components in (("a1\\,\\ a3", [0, 2]), ("a3\\,\\ a2", [2, 1])):
        executed = read(path, f"/stages/3\\ half/{pair}/executed", "Points2D:positions")
        np.testing.assert_array_equal(executed[0][-1], action[components])


@pytest.mark.parametrize("sets", [PLANE, CONFLICT], ids=["all hold", "one is dropped"])
def test_same_steps_give_the_same_recording(sets: dict, tmp_path: Path) -> None:
    for name in ("one", "other"):
        torch.manual_seed(0)
        record_steps(tmp_path / f"{name}.rrd", sets)
    torch.manual_seed(1)
    record_steps(tmp_path / "third.rrd", sets)
    same = compare(tmp_path / "one.rrd", tmp_path / "other.rrd")
    assert same.returncode == 0, same.stderr
    assert compare(tmp_path / "one.rrd", tmp_path / "third.rrd").returncode != 0


def test_random_numbers_elsewhere_are_left_alone(tmp_path: Path) -> None:
    actor = make_actor(PLANE)
    transition = actor(make_state(PLANE))
    before = torch.random.get_rng_state()
    with recorded(tmp_path / "r.rrd") as stream:
        FlowStream(stream, actor).log_step(0, transition)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_steps_with_gradients_are_logged(tmp_path: Path) -> None:
    actor = make_actor(PLANE, loc=torch.zeros(2, requires_grad=True))
    transition = actor(make_state(PLANE))
    assert transition["action"].requires_grad
    path = tmp_path / "r.rrd"
    with recorded(path) as stream:
        FlowStream(stream, actor).log_step(0, transition)
    executed = read(path, "/stages/4\\ speed/executed", "Points2D:positions")[0]
    np.testing.assert_array_equal(executed[-1], transition["action"].detach().numpy())


BROKEN = {
    "nan action": ("action", torch.tensor([torch.nan, 0.0]), r"'action' at step 5.*nan"),
    "infinite scale": ("scale", torch.tensor([torch.inf, 1.0]), r"'scale' at step 5.*inf"),
    "nan reward": (("next", "reward"), torch.tensor([torch.nan]), r"'reward'\) at step 5.*nan"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_numbers_that_would_not_be_drawn_are_refused(case: str) -> None:
    key, value, message = BROKEN[case]
    actor = make_actor(PLANE)
    transition = actor(make_state(PLANE)).set(key, value)

    stream = FlowStream(rr.RecordingStream("tests"), actor)
    with pytest.raises(ValueError, match=message):
        stream.log_step(5, transition)


ARGUMENTS = {
    "samples": ({"samples": 0}, 2, "samples: expected a number >= 1, given 0"),
    "every": ({"every": 0}, 2, "every: expected a number >= 1, given 0"),
    "cells": ({"cells": -1}, 2, "cells: expected a number >= 1, given -1"),
    "one component": ({"projections": [(0,)]}, 3, r"two different components in 0..2, given \(0,"),
    "the same twice": ({"projections": [(1, 1)]}, 3, r"two different components .* \(1, 1\)"),
    "out of range": ({"projections": [(0, 3)]}, 3, r"two different components .* \(0, 3\)"),
    "no pair": ({"projections": []}, 3, r"at least one pair, each once, given \[\]"),
    "on a line": ({"projections": [(0, 1)]}, 1, "none for an action of one component"),
}


@pytest.mark.parametrize("case", ARGUMENTS)
def test_bad_arguments_are_refused(case: str) -> None:
    arguments, dim, message = ARGUMENTS[case]
    with pytest.raises(ValueError, match=message):
        FlowStream(rr.RecordingStream("tests"), make_actor({}, dim=dim), **arguments)


def test_batch_of_steps_is_refused() -> None:
    actor = make_actor({})
    with pytest.raises(ValueError, match=r"one step .* given \(4,\); index it"):
        FlowStream(rr.RecordingStream("tests"), actor).log_step(0, TensorDict({}, [4]))


def test_another_process_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    actor = make_actor({})
    stream = FlowStream(rr.RecordingStream("tests"), actor)
    monkeypatch.setattr("os.getpid", lambda: -1)
    with pytest.raises(RuntimeError, match="from the process that opened the recording"):
        stream.log_step(0, actor(make_state({})))


def test_what_the_constraints_did_stands_beside_the_reward(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    (step,) = record_steps(path, SPACE, dim=3, steps=1)
    allowed, action = (
        read(path, f"/series/{name}", "Scalars:scalars")[0] for name in ("allowed", "action")
    )
    for constraint in SPACE:
        assert read(path, f"/series/moved/{constraint}", "Scalars:scalars")[0] >= 0
        assert read(path, f"/series/relaxation/{constraint}", "Scalars:scalars")[0] == 0
    assert 0 <= allowed[0] <= 100
    np.testing.assert_allclose(action, step["action"].numpy(), rtol=1e-6)


@pytest.mark.parametrize(("dim", "pairs"), [(3, 2), (4, 2), (5, 3), (6, 3)])
def test_every_component_is_shown_unless_projections_are_chosen(dim: int, pairs: int) -> None:
    shown = Setting.of(make_snapshot({}, dim=dim).head).projections
    assert len(shown) == pairs
    assert {component for pair in shown for component in pair} == set(range(dim))


def test_a_picture_is_streamed_where_a_step_has_one(tmp_path: Path) -> None:
    env = constrain_env(PointNavEnv([]), BatteryGeometry(), ObstacleGeometry())
    actor = make_constrained_actor(Gaussian(torch.zeros(2), torch.ones(2)), env)
    with open_recording(tmp_path / "recording.rrd") as recording:
        stream = FlowStream(recording, actor, env, samples=16, timeline="episode_0")
        for step, transition in enumerate(env.rollout(3, actor)):
            if step != 1:
                transition["pixels"] = torch.full((4, 6, 3), 99, dtype=torch.uint8)
            stream.log_step(step, transition)
    pictures = read(recording.path, "/picture", "EncodedImage:blob", "episode_0")
    assert sorted(pictures) == [0, 2]
    assert not read(recording.path, "/series/reward", "Scalars:scalars").keys() - {-1}


@pytest.mark.parametrize("dim", [1, 2])
def test_a_single_component_is_named_by_its_plots_title(dim: int) -> None:
    plots = task_plots(Setting.of(make_snapshot({}, dim=dim).head))
    (action,) = (plot for plot in plots if plot.name == "action")
    assert ("a1" in action.title) == (dim == 1)
    assert set(action.curves) == {f"a{i + 1}" for i in range(dim)}
