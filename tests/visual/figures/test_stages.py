"""The pictures of flow stages show the policy's own stages, samples and sets."""

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as Polygon
from torchrl.envs import EnvBase, TransformedEnv

from cnfp_torchrl.envs import Component, ShowTask, TaskView
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.visual import FlowSnapshot, constraint_colors
from cnfp_torchrl.visual.figures import flow_stages
from tests.pictures import draws
from tests.visual.cases import (
    CONFLICT,
    LINE,
    PLANE,
    PLANE_OF_OTHERS,
    SPACE,
    first,
    make_snapshot,
)

FLOWS = ["exact", "radial", "squash", "unconstrained"]


def stage_panels(figure: Figure, snapshot: FlowSnapshot) -> list[Axes]:
    panels = [axes for axes in figure.axes if axes.get_title().startswith("stage ")]
    assert len(panels) == len(snapshot.stages)
    return panels


def drawn(axes: Axes, label: str) -> np.ndarray:
    """Return the points of all lines with a label."""
    lines = [line.get_xydata() for line in axes.lines if line.get_label() == label]
    return np.concatenate(lines)


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_panel_for_each_stage(count: int, flow: str) -> None:
    snapshot = make_snapshot(first(PLANE, count), flow)
    figure = flow_stages(snapshot)
    titles = [axes.get_title().split("\n")[0] for axes in stage_panels(figure, snapshot)]
    names = {
        "exact": ["action bounds", *first(PLANE, count)],
        "radial": ["action bounds", *first(PLANE, count)],
        "squash": list(first(PLANE, count)) or ["action bounds"],
        "unconstrained": ["action bounds"],
    }[flow]
    assert titles == [f"stage {i}: {name}" for i, name in enumerate(names, start=1)]
    assert count < 3 or draws(figure)


@pytest.mark.parametrize("flow", ["exact", "radial"])
@pytest.mark.parametrize("sets", [PLANE, PLANE_OF_OTHERS, CONFLICT])
def test_all_samples_lie_inside_the_drawn_set(sets: dict[str, ConstraintSet], flow: str) -> None:
    snapshot = make_snapshot(sets, flow, samples=1000)
    for axes in stage_panels(flow_stages(snapshot), snapshot):
        so_far = Polygon(drawn(axes, "set so far"))
        samples = drawn(axes, "samples")
        assert len(samples) == 1000
        # Saturated samples lie on the edge, which is drawn as a polygon.
        assert so_far.contains_points(samples, radius=1e-3).all()
        assert "0 of 1000" in axes.get_title()


@pytest.mark.parametrize("flow", ["squash", "unconstrained"])
def test_samples_outside_are_marked_and_counted(flow: str) -> None:
    snapshot = make_snapshot(PLANE, flow, samples=1000)
    last = stage_panels(flow_stages(snapshot), snapshot)[-1]
    outside = drawn(last, "outside")
    broken = ~snapshot.region.contains(torch.tensor(outside))
    assert 0 < len(outside) < 1000
    assert broken.all()
    assert last.get_title().endswith(f"{len(outside)} of 1000 break a constraint")
    assert snapshot.region.contains(torch.tensor(drawn(last, "samples"))).all()


def test_constraints_keep_their_colors_in_every_panel() -> None:
    sets = {**PLANE, **PLANE_OF_OTHERS}
    colors = constraint_colors(sets)
    for names in (["battery", "visible"], ["power", "obstacle"]):
        snapshot = make_snapshot({name: sets[name] for name in names})
        figure = flow_stages(snapshot, colors=colors)
        for axes in stage_panels(figure, snapshot):
            for name in names:
                shown = {ln.get_color() for ln in axes.lines if ln.get_label() == name}
                assert shown == {colors[name]}
        legend = {text.get_text() for text in figure.legends[0].get_texts()}
        assert {f"{name} set" for name in names} < legend


def test_sets_not_yet_applied_are_dotted() -> None:
    snapshot = make_snapshot(first(PLANE, 2))
    panels = stage_panels(flow_stages(snapshot), snapshot)
    solid = [
        {
            ln.get_label()
            for ln in axes.lines
            if ln.get_label() in PLANE and ln.get_linestyle() == "-"
        }
        for axes in panels
    ]
    assert solid == [set(), {"battery"}, {"battery", "obstacle"}]


def test_dropped_constraint_is_told_and_dotted() -> None:
    snapshot = make_snapshot(CONFLICT)
    far = stage_panels(flow_stages(snapshot), snapshot)[1]
    assert "far (dropped here)" in far.get_title()
    assert all(ln.get_linestyle() != "-" for ln in far.lines if ln.get_label() == "far")


@pytest.mark.parametrize("flow", FLOWS)
def test_one_action_component(flow: str) -> None:
    snapshot = make_snapshot(LINE, flow, dim=1)
    figure = flow_stages(snapshot)
    for axes in stage_panels(figure, snapshot):
        (curve,) = (ln for ln in axes.lines if ln.get_label() == "density")
        x, density = curve.get_data()
        assert np.trapezoid(density, x) == pytest.approx(1, abs=0.02)
    assert draws(figure)


@pytest.mark.parametrize("flow", ["exact", "radial", "unconstrained"])
def test_three_action_components(flow: str) -> None:
    snapshot = make_snapshot(SPACE, flow, dim=3)
    figure = flow_stages(snapshot)
    assert "first two of 3" in figure.get_suptitle()
    for axes in stage_panels(figure, snapshot):
        # Rays that miss a corner cut it off by some thousandths.
        shadow = Polygon(drawn(axes, "set so far"))
        inside = axes.collections[0].get_offsets()
        assert shadow.contains_points(inside, radius=1e-2).all()
    assert draws(figure)


@pytest.mark.parametrize("flow", FLOWS)
def test_saturated_policies_are_drawn(flow: str) -> None:
    loc, scale = torch.tensor([1e6, -1e6]), torch.tensor([1e-8, 1e4])
    assert draws(flow_stages(make_snapshot(PLANE, flow, loc=loc, scale=scale)))


def test_followed_action_is_drawn_through_the_stages() -> None:
    snapshot = make_snapshot(PLANE).following_the_longest_path()
    path = snapshot.path().numpy()
    for i, axes in enumerate(stage_panels(flow_stages(snapshot), snapshot)):
        (now,) = (line for line in axes.lines if line.get_marker() == "D")
        np.testing.assert_allclose(now.get_xydata(), path[i : i + 1])


def env_of(*components: Component) -> EnvBase:
    view = TaskView()
    view.action_components = components
    return TransformedEnv(PointNavEnv([]), ShowTask(view))


@pytest.mark.parametrize("sets", [LINE, PLANE, SPACE])
def test_axes_have_the_names_and_units_that_the_task_gives(sets: dict[str, ConstraintSet]) -> None:
    snapshot = make_snapshot(sets, dim=next(iter(sets.values())).dim)
    named = [Component("valve", "%/s"), Component("pan", "rad/s"), Component("grip")]
    figure = flow_stages(snapshot, env=env_of(*named[: snapshot.dim]))
    base = next(axes for axes in figure.axes if axes.get_title().startswith("base"))
    panels = stage_panels(figure, snapshot)
    assert base.get_xlabel() == "z of valve"
    assert {axes.get_xlabel() for axes in panels} == {"valve (%/s)"}
    assert panels[0].get_ylabel() == ("density" if snapshot.dim == 1 else "pan (rad/s)")
    without = stage_panels(flow_stages(snapshot), snapshot)
    assert without[0].get_xlabel() == "a1"


def test_two_components_of_one_name_are_refused() -> None:
    env = env_of(Component("joint", "rad"), Component("joint", "N m"))
    with pytest.raises(ValueError, match=r"^action_components: .*'joint', 'joint'"):
        flow_stages(make_snapshot(PLANE), env=env)
