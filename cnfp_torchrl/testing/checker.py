"""The checker of families of sets, and the order of its checks."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.geometry import Box, ConstraintSet
from cnfp_torchrl.testing import flows, gauges, ranges, shapes, slacks
from cnfp_torchrl.testing.example import Example

# Ordered: a check relies on what those before it have found to be right.
OF_SHAPES = (
    shapes.check_event_dims,
    shapes.check_invalid_fields,
    shapes.check_output_shapes,
    shapes.check_batches,
)
ABOUT_THE_GIVEN_ANCHOR = (
    slacks.check_slack_at_the_anchor,
    slacks.check_contains_agrees_with_slack,
    slacks.check_slack_bounds_the_distance,
    slacks.check_slack_is_concave,
    slacks.check_superlevel,
    slacks.check_rows,
    slacks.check_inflated,
    slacks.check_deepest_within,
    gauges.check_gauge_is_where_rays_leave,
)
ABOUT_ALL_ANCHORS = (
    gauges.check_gauge_is_where_rays_leave,
    gauges.check_gauge_is_homogeneous,
    gauges.check_gauge_about,
    gauges.check_gauge_gradient_is_finite,
    gauges.check_gauge_gradient,
    slacks.check_contains_is_exact,
    slacks.check_bounding_box,
    flows.check_erosion_covers_rounding,
    flows.check_erosion_is_small,
    gauges.check_gauge_in_float32,
    flows.check_flow_stays_inside,
    flows.check_log_det,
    flows.check_around_contains_the_ball,
    flows.check_dropped_sets_do_not_bind,
    slacks.check_search_keeps_the_set,
    ranges.check_field_range,
)


def check_constraint_set(
    sets: ConstraintSet,
    anchor: Tensor,
    *,
    bounds: Box | None = None,
    samples: int = 100,
    seed: int = 0,
) -> None:
    """Check that a family of sets keeps the contract of `ConstraintSet`, by an example.

    Args:
        sets: The batch of different sets of the family, in float32 or float64, rounded to float32.
        anchor: Points well inside the sets, ``(*batch, d)``, best not their middles. A set that is
            not convex must be star-shaped about its anchor.
        bounds: The finite action bounds that hold the anchors and are wider than the sets in some
            directions; by default some times wider than the sets are where they are narrow.
        samples: The number of directions from each anchor: the given one and four near the
            boundary.
        seed: The seed of the checker's own random numbers; the global generator is left alone.

    Raises:
        FamilyError: naming family, method, batch element with its fields, direction or action, what
            was expected and given.
        ValueError: when the anchor has another dtype, or the bounds do not hold the anchors.
    """
    for check_shapes in OF_SHAPES:
        check_shapes(sets, anchor)
    # Whatever mode the caller is in, gradients are needed, and a family may draw random numbers.
    with torch.enable_grad(), torch.random.fork_rng(devices=[]):
        example = Example.of(sets, anchor, bounds, samples, seed)
        for check in ABOUT_THE_GIVEN_ANCHOR:
            check(example)
        example = example.with_anchors_near_the_boundary(samples)
        for check in ABOUT_ALL_ANCHORS:
            check(example)
