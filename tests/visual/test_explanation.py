"""What is said of a step is what happened in it."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase

from cnfp_torchrl.envs import Component, TaskView
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet
from cnfp_torchrl.visual import FlowSnapshot
from cnfp_torchrl.visual.explanation import ConstraintEffect, Explanation, explain
from tests.visual.cases import CONFLICT, LINE, PLANE, RELAXED, SPACE, make_snapshot

t = torch.tensor
STILL = torch.full((2,), 1e-3)


def executing(sets: dict[str, ConstraintSet], at: list[float], flow: str = "exact") -> FlowSnapshot:
    """Return a snapshot whose samples all lie within a hair of one latent."""
    return make_snapshot(sets, flow, loc=t(at), scale=STILL, samples=50)


def effects(explanation: Explanation) -> dict[str, str]:
    return {part.name: part.effect for part in explanation.constraints}


def only(explanation: Explanation) -> ConstraintEffect:
    (effect,) = explanation.constraints
    return effect


def test_a_constraint_that_binds_is_restrictive() -> None:
    # tanh(1) = 0.762 in both components; the box ends at 0.5 in the first one, which is scaled
    # about the anchor, 0 (the box is symmetric): tanh reaches 1 where the wall reaches 0.5.
    walls = {"wall": Box(t([-0.5, -1.0]), t([0.5, 1.0]))}
    explanation = explain(executing(walls, [1.0, 1.0]))
    wall = only(explanation)
    assert wall.effect == "restrictive"
    assert wall.share_moved == 1
    assert wall.share_allowed == pytest.approx(0.5, abs=0.01)
    assert wall.share_outside == 0
    assert wall.before == pytest.approx((0.762, 0.762), abs=0.005)
    assert wall.after == pytest.approx((0.381, 0.762), abs=0.005)
    assert wall.moved == pytest.approx(0.381, abs=0.005)
    assert explanation.action == wall.after
    assert "The wall constraint moved the action by 0.38" in explanation.text()


def test_a_constraint_that_does_not_bind_is_permissive() -> None:
    far = {"far": Ball(t([0.0, 0.0]), t(9.0))}
    explanation = explain(executing(far, [1.0, 1.0]))
    assert only(explanation).effect == "permissive"
    assert only(explanation).moved == 0
    assert only(explanation).share_allowed == 1
    assert only(explanation).before == only(explanation).after
    assert "No constraint moved the action." in explanation.text()
    assert "The far constraint moved none of 50 samples." in explanation.text()


def test_a_constraint_can_bind_on_other_samples_alone() -> None:
    wall = {"wall": Box(t([-1.0, -1.0]), t([0.5, 1.0]))}
    snapshot = make_snapshot(wall, loc=t([-0.5, 0.0]), samples=500)
    moved = snapshot.stages[1].samples != snapshot.stages[0].samples
    left = int((~moved.any(-1)).nonzero()[0])
    explanation = explain(replace(snapshot, followed=left))
    assert only(explanation).effect == "restrictive"
    assert only(explanation).moved == 0
    share = only(explanation).share_moved
    assert share is not None
    assert share == pytest.approx(float(moved.any(-1).double().mean()), abs=0.02)
    assert "left the action where it was" in explanation.text()


def test_a_constraint_that_cannot_hold_is_dropped() -> None:
    explanation = explain(make_snapshot(CONFLICT))
    assert effects(explanation) == {"far": "dropped", "near": "restrictive"}
    reason = "no action within the bounds keeps it together with near."
    assert f"The far constraint is dropped: {reason}" in explanation.text()
    assert "the far constraint is dropped" in explanation.markdown()


def test_a_constraint_that_is_widened_is_relaxed() -> None:
    explanation = explain(make_snapshot(RELAXED))
    assert effects(explanation) == {"far": "relaxed", "near": "restrictive"}
    far, _ = explanation.constraints
    # The nearest points of the balls are apart by the distance of their centers without the radii.
    assert far.relaxation == pytest.approx(1.8 * 2**0.5 - 1.1, abs=0.01)
    assert far.share_outside == 0
    for text in (explanation.text(), explanation.markdown()):
        assert f"relaxed by {far.relaxation:.3g}" in text


@pytest.mark.parametrize("flow", ["unconstrained", "squash"])
def test_flows_that_guarantee_nothing_are_seen_to_break(flow: str) -> None:
    snapshot = make_snapshot(PLANE, flow, samples=500)
    for index in range(50):
        explanation = explain(replace(snapshot, followed=index))
        action = snapshot.stages[-1].samples[index]
        for effect, allowed in zip(explanation.constraints, snapshot.region.sets[1:], strict=True):
            inside = bool(allowed.contains(action))
            assert (effect.effect == "broken") == (not inside)
            assert (effect.slack < 0) == (not inside)
            assert effect.share_moved is None
            outside = ~allowed.contains(snapshot.stages[-1].samples)
            assert effect.share_outside == pytest.approx(float(outside.double().mean()))
    text = explain(snapshot).text()
    assert ("action breaks the " in text.replace("\n", " ")) == (
        "broken" in effects(explain(snapshot)).values()
    )


def test_shares_are_areas() -> None:
    # Ball of radius 0.8 in a square of side 2; the box cuts [0.5, 1] and [0.4, 1] off.
    explanation = explain(make_snapshot({name: PLANE[name] for name in ("speed", "obstacle")}))
    speed, obstacle = explanation.constraints
    assert speed.share_allowed == pytest.approx(torch.pi * 0.64 / 4, abs=0.02)
    assert obstacle.share_allowed == pytest.approx(1.5 * 1.4 / 4, abs=0.02)
    assert explanation.share_allowed is not None
    assert explanation.share_allowed < min(speed.share_allowed, obstacle.share_allowed)


@pytest.mark.parametrize(
    ("sets", "dim", "flow"),
    [
        (LINE, 1, "exact"),
        (LINE, 1, "squash"),
        (PLANE, 2, "radial"),
        (SPACE, 3, "exact"),
        ({}, 5, "exact"),
    ],
)
def test_any_dimension_and_any_number_of_constraints(
    sets: dict[str, ConstraintSet], dim: int, flow: str
) -> None:
    snapshot = make_snapshot(sets, flow, dim=dim)
    explanation = explain(snapshot)
    assert [part.name for part in explanation.constraints] == list(sets)
    assert len(explanation.action) == dim
    assert (explanation.share_allowed is None) == (dim > 3)
    for text in (explanation.text(), explanation.markdown()):
        assert all(name in text for name in sets)
        assert "nan" not in text
        assert "None" not in text
        assert max(map(len, explanation.text().splitlines())) <= 100
    assert all(component.title in explanation.text() for component in explanation.components)


class Home(TaskView):
    def situation(self, state: TensorDictBase) -> str:
        return "At home."

    def constraint_sentences(self, state: TensorDictBase) -> dict[str, str]:
        return {"box": "The end is near."}


def test_what_the_task_says_is_passed_on() -> None:
    explanation = explain(make_snapshot(LINE, dim=1), Home())
    for text in (explanation.text().replace("\n", " "), explanation.markdown()):
        assert "At home." in text
        assert text.count("The end is near.") == 1


def test_an_action_of_another_policy_has_no_way() -> None:
    explanation = explain(replace(make_snapshot(PLANE), is_recovered=False))
    assert explanation.latent is None
    assert all(part.before is None and part.moved is None for part in explanation.constraints)
    assert "the way of the action itself is unknown" in explanation.text()


def test_markdown_is_a_table() -> None:
    lines = explain(make_snapshot({"a|b": PLANE["speed"]})).markdown().splitlines()
    rows = [line for line in lines if line.startswith("|")]
    # Of the constraint and all together, and of two components; each with a head.
    assert len(rows) == 4 + 4
    counts = [row.replace("\\|", "").count("|") for row in rows]
    assert counts == [7] * 4 + [6] * 4


def test_names_and_units_are_those_of_the_task() -> None:
    force = [Component("push", "N"), Component("lift", "N")]
    text = explain(make_snapshot(PLANE), components=force).text()
    for words in ("push (N)", "lift (N)", "moved (N)", "slack (N)"):
        assert words in text
    mixed = [Component("push", "N"), Component("turn", "N m")]
    assert explain(make_snapshot(PLANE), components=mixed).unit == "action units"
