"""Cheap attempts: what they decide, against the certified search, over families and random sets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    HalfSpaces,
    PositivePart,
    attempt_anchor,
    lexicographic_anchor,
)
from cnfp_torchrl.geometry.anchor import chebyshev_center, row_depths
from cnfp_torchrl.geometry.anchor.ascent import Ascent
from cnfp_torchrl.geometry.anchor.attempts import REFINEMENT, first_attempt, stepped_attempt
from experiments.benchmarks.anchors import random_sets
from tests.geometry.cases import CASES, DTYPES, Case


def least_slack(sets: list[ConstraintSet], action: Tensor) -> Tensor:
    """Return the smallest slack in all sets."""
    return torch.stack([s.row_slacks(action).amin(-1) for s in sets]).amin(0)


@pytest.mark.parametrize("case", [case for case in CASES if case.convex], ids=lambda c: c.name)
def test_attempts_decide_all_families(case: Case) -> None:
    """Sets small beside the bounds, or with a null space: a middle alone would not do."""
    dtype = DTYPES[CASES.index(case) % 2]
    sets = [case.bounds.to(dtype), case.sets.to(dtype)]
    sets = [s.with_fields(lambda f, dims: f.expand(shape_of(case) + end(f, dims))) for s in sets]
    anchor, decided = attempt_anchor(sets)
    flat = [s.select(shape_of(case), torch.arange(case.inside[..., 0].numel())) for s in sets]
    best = chebyshev_center(flat).slack
    depth = torch.cat(row_depths(flat), -1).amax(-1)
    assert (decided.flatten() | (best < 2 * depth)).all()
    slack = least_slack(flat, anchor.reshape(-1, anchor.shape[-1])).double()
    assert (slack >= 0.3 * best)[decided.flatten()].all()


@pytest.mark.parametrize("dim", [1, 2, 4])
def test_a_ball_beside_boxes_is_decided_in_closed_form(dim: int) -> None:
    """Without steps: in every state whose best slack is more than the depth, however small."""
    generator = torch.Generator().manual_seed(dim)

    def normal(*shape: int) -> Tensor:
        return torch.randn(2000, *shape, generator=generator, dtype=torch.float64)

    low = normal(dim) - 0.5
    box = Box(low, low + normal(dim).abs())
    # Balls from afar, whose boundary crosses the box, and far beyond it.
    center, room = normal(dim) * 10 ** normal(1), normal().abs() * 10 ** (2 * normal() - 1)
    nearest = center.clamp(*Box(-torch.ones(dim), torch.ones(dim)).fields().values())
    radius = (nearest.clamp(box.low, box.high) - center).norm(dim=-1) + room
    bounds = Box(-torch.ones(2000, dim).double(), torch.ones(2000, dim).double())
    sets = [bounds, box, Ball(center, radius)]
    anchor, decided = attempt_anchor(sets, steps=0)
    best = chebyshev_center(sets, share=0.99)
    depth = torch.cat(row_depths(sets), -1).amax(-1)
    assert 500 < decided.sum() < 1900
    assert (decided | (best.slack < 4 * depth)).all()
    assert not (decided & (best.upper_bound < depth)).any()
    assert (least_slack(sets, anchor) >= 0.3 * best.slack)[decided].all()


def shape_of(case: Case) -> torch.Size:
    """Return the batch shape of a case."""
    return case.inside.shape[:-1]


def end(field: Tensor, dims: int) -> torch.Size:
    """Return the event shape of a field."""
    return field.shape[field.ndim - dims :]


def test_attempts_tell_most_random_intersections_apart() -> None:
    """Also tight and empty ones, in float32: nothing is claimed that the search contradicts."""
    rng = np.random.default_rng(1)
    held = decided_held = empty = decided_empty = 0
    for _ in range(40):
        wide = random_sets(rng, 20)
        sets = [s.to(torch.float32, "cpu") for s in wide]
        best = chebyshev_center(wide, share=0.99)
        depth = torch.cat([d.expand(20, -1) for d in row_depths(sets)], -1).amax(-1)
        ascent = Ascent(sets, torch.zeros(20, wide[0].dim), torch.ones(20))
        ascent.run(6)
        anchor, decided = attempt_anchor(sets, steps=6)
        can, cannot = best.slack > depth, best.upper_bound < -depth
        held, decided_held = held + int(can.sum()), decided_held + int((can & decided).sum())
        none = ascent.bound < -depth
        empty, decided_empty = empty + int(cannot.sum()), decided_empty + int((cannot & none).sum())
        assert not (decided & ~(best.upper_bound > 0)).any()
        assert not (none & (best.slack > -depth)).any()
        assert (least_slack(sets, anchor) >= 0.29 * best.slack)[decided & can].all()
        assert (ascent.bound >= best.slack - 1e-3 * best.slack.abs() - 1e-6)[can].all()
    assert decided_held > 0.85 * held > 200
    assert decided_empty > 0.75 * empty > 50


def test_steps_of_compiled_code_lead_where_others_do() -> None:
    """Taken in all states at once, and no fewer of them are decided."""
    rng = np.random.default_rng(2)
    most = few = 0
    for _ in range(20):
        sets = [s.to(torch.float32, "cpu") for s in random_sets(rng, 20)]
        found = lexicographic_anchor(sets)
        for steps in (0, 1, REFINEMENT):
            anchor, _, decided = stepped_attempt(sets, first_attempt(sets), steps)
            torch.testing.assert_close(anchor[decided], found.anchor[decided], rtol=0, atol=1e-5)
            assert found.active[decided].all()
        most, few = most + int(decided.sum()), few + int(first_attempt(sets).decided.sum())
    assert most > 1.3 * few > 60


def test_steps_go_on_where_they_have_arrived() -> None:
    """Many more steps than are needed move a point no more, and spoil no bound."""
    bounds = Box(-torch.ones(5, 3), torch.ones(5, 3))
    rows = HalfSpaces(torch.randn(5, 4, 3), 0.05 + torch.rand(5, 4))
    parts = PositivePart(torch.tensor([0.03, -0.0, -0.0]), torch.tensor(0.004))
    sets = [bounds, rows, parts]
    for steps in (4, 40):
        anchor, decided = attempt_anchor(sets, steps=steps)
        assert decided.all()
        ascent = Ascent(sets, torch.zeros(5, 3), torch.ones(5))
        ascent.run(steps)
        assert ascent.point.isfinite().all()
        assert (ascent.bound >= least_slack(sets, anchor) - 1e-6).all()


def test_weights_of_either_zero_leave_their_components_free() -> None:
    free = torch.tensor([torch.inf, torch.inf])
    for bound in (0.0, 2.0):
        parts = PositivePart(torch.tensor([[0.0, 1.0], [-0.0, -1.0]]), torch.tensor(bound))
        box = parts.bounding_box()
        assert box.low.tolist() == [[-torch.inf, -torch.inf], [-torch.inf, -bound]]
        assert box.high.tolist() == [[torch.inf, bound], free.tolist()]
