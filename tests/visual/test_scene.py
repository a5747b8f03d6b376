"""The arrays of a scene are the policy's own, in any dimension."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.envs import NOTHING, Map, TaskView
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.modules import ProjectionFlow, flow_head
from cnfp_torchrl.visual import Scene, Setting
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.scene import PRINTED, Detail, base_density, density_limits
from cnfp_torchrl.visual.snapshot import FlowSnapshot, stage_bijector
from tests.visual.cases import (
    CASES,
    CONFLICT,
    LINE,
    PLANE,
    SPACE,
    flows_in_cases,
    make_actor,
    make_snapshot,
    make_state,
)


def setting_of(snapshot: FlowSnapshot, view: TaskView = NOTHING) -> Setting:
    return replace(Setting.of(snapshot.head).holding(snapshot), view=view)


def scene_of(snapshot: FlowSnapshot, reach: float | None = None, cells: int = 31) -> Scene:
    setting = setting_of(snapshot)
    if reach is not None:
        setting = replace(setting, reach=reach, leaves_bounds=True)
    return Scene(setting, snapshot, Detail(cells))


@flows_in_cases(
    "exact",
    "radial",
    "squash",
    "unconstrained",
    cases=[name for name, (_, dim) in CASES.items() if dim <= 2],
)
def test_last_stage_is_the_policys_log_density(
    flow: str, sets: dict[str, ConstraintSet], dim: int
) -> None:
    actor = make_actor(sets, flow, dim=dim, loc=torch.full((dim,), 0.3))
    step = actor(make_state(sets, dim))
    snapshot = replay_step(actor, step, torch.zeros(1, dim))
    scene = scene_of(snapshot, reach=1.1)
    cells = (31, 31) if dim == 2 else (124,)
    assert scene.log_density is not None
    assert scene.log_density.shape == (len(snapshot.stages), *cells)
    base = Independent(Normal(step["loc"].double(), step["scale"].double()), 1)
    bijector = stage_bijector(
        snapshot.head.flow, snapshot.region.to(torch.float64), snapshot.stages[-1].applied
    )
    expected = ConstrainedFlow(base, bijector).log_prob(scene.actions.double())
    # A tenth of a step in brightness; bounds of float32 are eroded by more than those of float64.
    given = scene.log_density[-1].double()
    torch.testing.assert_close(given, expected, atol=0.1 * 7 / 255, rtol=0)


@pytest.mark.parametrize("flow", ["exact", "radial", "squash"])
@pytest.mark.parametrize(("sets", "dim"), [(PLANE, 2), (LINE, 1)])
def test_every_stage_integrates_to_one(sets: dict, dim: int, flow: str) -> None:
    reach = 2.0
    scene = scene_of(make_snapshot(sets, flow, dim=dim), reach, cells=400 if dim == 2 else 2000)
    assert scene.log_density is not None
    cells = scene.actions.shape[0]
    density = scene.log_density.double().exp().flatten(1)
    mass = density.sum(1) * (2 * reach / cells) ** dim
    # The cells that a boundary cuts count as a whole or not at all.
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=0.03, rtol=0)


def heat_of(log_density: Tensor) -> np.ndarray:
    scene = scene_of(make_snapshot({}))
    scene.__dict__["log_density"] = log_density
    assert scene.heat is not None
    return scene.heat


def test_stages_share_one_scale_of_brightness() -> None:
    low, high = torch.full((4, 4), -2.0), torch.full((4, 4), 1.0)
    high[0, 0] = -torch.inf
    dark, bright = heat_of(torch.stack([low, high]).double())
    assert bright[0, 0] == 0
    assert (bright.reshape(-1)[1:] == 255).all()
    np.testing.assert_array_equal(dark, round(255 * 4 / 7))


def test_no_density_anywhere_is_dark() -> None:
    assert not heat_of(torch.full((2, 3, 3), -torch.inf).double()).any()


def test_base_density_is_the_gaussians() -> None:
    loc, scale = torch.tensor([0.3, -1.0]), torch.tensor([0.2, 1.5])
    latents, log_density = base_density(make_snapshot(PLANE, loc=loc, scale=scale), 3.0, 11)
    assert latents.shape == (11, 11, 2)
    expected = Independent(Normal(loc, scale), 1).log_prob(latents)
    torch.testing.assert_close(log_density, expected)


def test_color_scale_holds_the_bulk_of_the_samples() -> None:
    snapshot = make_snapshot(PLANE, samples=2000)
    low, high = density_limits(snapshot)
    values = torch.cat([stage.log_density for stage in snapshot.stages])
    assert 0.7 < float(((values > low) & (values < high)).double().mean()) < 1
    saturated = make_snapshot(PLANE, loc=torch.tensor([1e9, 0.0]), scale=torch.tensor([1e-9, 1.0]))
    low, high = density_limits(saturated)
    assert high - low >= 3


@pytest.mark.parametrize("flow", ["exact", "squash", "unconstrained"])
@pytest.mark.parametrize(("sets", "dim"), [(LINE, 1), (PLANE, 2), (SPACE, 3), ({}, 5)])
def test_every_sample_is_in_view_and_on_its_path(sets: dict, dim: int, flow: str) -> None:
    if flow == "squash" and dim == 3:
        pytest.skip("half-spaces have no squash")
    snapshot = make_snapshot(sets, flow, dim=dim)
    scene = scene_of(snapshot)
    limits = np.array(scene.setting.limits)
    for row in scene.setting.rows():
        for view in row:
            samples = scene.samples(view.stage, view.components)
            low, high = limits[list(view.components)].T
            assert (samples >= low).all()
            assert (samples <= high).all()
            path = scene.path(view.stage, view.components)
            expected = snapshot.path()[: view.stage + 1, list(view.components)]
            np.testing.assert_array_equal(path, expected)
            tracks = scene.tracks(view.stage, view.components, 7)
            assert len(tracks) == (7 if view.stage else 0)
            if view.stage:
                np.testing.assert_array_equal(tracks[:, 1], samples[1:8])
    assert (scene.log_density is None) == (dim > 2)
    assert list(scene.moved) == list(sets)


def test_outlines_are_of_sets_that_hold_or_of_dropped_ones() -> None:
    scene = scene_of(make_snapshot(CONFLICT))
    assert not scene.set_lines(1, (0, 1))
    assert scene.dropped_lines(1, (0, 1))
    assert scene.set_lines(2, (0, 1))
    assert not scene.dropped_lines(2, (0, 1))


def test_interval_of_one_component() -> None:
    scene = scene_of(make_snapshot(LINE, dim=1))
    assert scene.interval((0,)) == pytest.approx((-1, 1))
    assert scene.interval((0, 1)) == pytest.approx((-0.7, 0.4))
    assert scene.interval((0, 1, 2)) == pytest.approx((-0.2, 0.4))


def test_shadows_hold_what_sections_do() -> None:
    snapshot = make_snapshot(SPACE, dim=3)
    section, shadow = (
        Scene(setting_of(snapshot), snapshot, detail).allowed_lines(2, (0, 1))
        for detail in (Detail(), PRINTED)
    )

    def area(lines: list[np.ndarray]) -> float:
        (x, y), *_ = (line.T for line in lines)
        return abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())) / 2

    assert area(shadow) > 1.05 * area(section)


class OnTheMap(TaskView):
    def __init__(self, step_length: float | None) -> None:
        self.map = Map((-2.0, 2.0), (-2.0, 2.0), step_length=step_length)

    def position(self, states: TensorDictBase) -> Tensor:
        return states["observation"][..., :2]


def test_moves_stand_where_the_agent_does() -> None:
    snapshot = make_snapshot(PLANE)
    snapshot.state["observation"] = torch.tensor([0.5, -1.0, 0.0])
    scene = Scene(setting_of(snapshot, OnTheMap(0.1)), snapshot)
    shown = scene.on_map(targets=20)
    assert shown is not None
    np.testing.assert_allclose(shown.position, [0.5, -1.0])
    assert shown.goal is None
    expected = shown.position + 0.1 * snapshot.stages[-1].samples[1:21].numpy()
    np.testing.assert_allclose(shown.targets, expected)
    (edge,) = shown.allowed
    inside = snapshot.region.anchor + 0.999 * (
        torch.from_numpy((edge - shown.position) / 0.1).float() - snapshot.region.anchor
    )
    assert snapshot.region.contains(inside).all()


def test_actions_that_are_no_moves_are_not_drawn_on_the_map() -> None:
    snapshot = make_snapshot(PLANE)
    shown = Scene(setting_of(snapshot, OnTheMap(None)), snapshot).on_map(targets=20)
    assert shown is not None
    assert not shown.sets
    assert not shown.allowed
    assert len(shown.targets) == 0


def test_without_a_map_there_is_none() -> None:
    assert scene_of(make_snapshot(PLANE)).on_map(targets=20) is None


def test_flow_without_density_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a flow with a density.*given ProjectionFlow"):
        Setting.of(flow_head(make_actor(PLANE, ProjectionFlow())))
