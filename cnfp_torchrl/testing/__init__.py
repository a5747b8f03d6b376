"""A checker for families of sets of one's own, in the spirit of `torch.autograd.gradcheck`.

`check_constraint_set` takes an example of a family and anchors inside its sets, and raises a
`FamilyError` that names the method that breaks the contract of `ConstraintSet`, and where.

Of fields and shapes:

- `check_event_dims`: it maps each field to its number of event dimensions and fits the example,
- `check_invalid_fields`: it yields what it has to, and accepts the example,
- `check_output_shapes`: shapes ``(*sample, *batch)`` of results, event shapes of sets,
- `check_batches`: batch elements do not mix, and batch shapes broadcast.

Of slack and containment, and of what the search for anchors is told:

- `check_slack_at_the_anchor`, `check_contains_agrees_with_slack`, `check_contains_is_exact`,
- `check_slack_bounds_the_distance`: no action nearer than the slack is on the other side,
- `check_slack_is_concave`: with the right gradient, unless `superlevel` is stated,
- `check_superlevel`: it describes no more than the set, and all of a convex one,
- `check_rows`, `check_inflated`: what is relaxed where the constraint cannot hold, and by how much,
- `check_search_keeps_the_set`: what holds is not dropped,
- `check_bounding_box`: it holds the set,
- `check_deepest_within`: no point of a box has more slack.

Of gauges, about the given anchor and about others near the boundary, where arithmetic is worst:

- `check_gauge_is_where_rays_leave`: by steps along rays, judged by `contains`,
- `check_gauge_is_homogeneous`, `check_gauge_about`,
- `check_gauge_in_float32`: the exit misses the boundary by rounding errors alone,
- `check_gauge_gradient_is_finite`, `check_gauge_gradient`: against finite differences.

Of what flows need:

- `check_erosion_covers_rounding`, `check_erosion_is_small`: enough is taken away, and not too much,
- `check_flow_stays_inside`: saturated float32 and float64 samples, with zero tolerance,
- `check_log_det`: a flow's log-determinant is autograd's,
- `check_around_contains_the_ball`, `check_dropped_sets_do_not_bind`,
- `check_field_range`: fields over the whole range of float32 and float64.
"""

from cnfp_torchrl.testing.checker import check_constraint_set
from cnfp_torchrl.testing.family_error import FamilyError

__all__ = ["FamilyError", "check_constraint_set"]
