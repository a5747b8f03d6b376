"""Two telling states of an environment: one that permits much and one where constraints bind."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import find_task_view
from cnfp_torchrl.geometry import Region
from cnfp_torchrl.modules import ConstrainedFlowModule

_DIRECTIONS = 256
_VISIBLE = 0.15
"""A constraint that makes this share of the region's edge can be seen."""
_LEGIBLE = 0.25
"""Regions that are open for less than this share of the way to the bounds are hard to see."""


@torch.no_grad()
def telling_states(
    env: EnvBase, head: ConstrainedFlowModule, *, steps: int = 100
) -> tuple[TensorDictBase, TensorDictBase]:
    """Return a permissive and a restrictive state, each of batch size ``()``.

    The permissive one leaves the largest share of the action bounds open with no constraint
    dropped. In the restrictive one every constraint makes a visible part of the region's edge, as
    far as there is such a state, and the region is small.

    A task may say among which states to look (`TaskView.candidate_states`); any other environment
    is stepped at random, within the constraints.

    Args:
        env: The environment, with geometry, anchor and active flags; it is reset. A larger batch
            looks at more states.
        head: The flow module of an actor for it.
        steps: The length of the random walk.
    """
    candidates = find_task_view(env).candidate_states(env)
    if candidates is None:
        walk = env.rollout(steps, head.random, break_when_any_done=False).reshape(-1)
        candidates = walk, walk
    wide, tight = candidates
    region = head.get_region(wide)
    share, _ = openness(region)
    share = share * region.is_active.all(-1)
    permissive = wide[int(share.argmax())]
    share, edge = openness(head.get_region(tight))
    enough = edge.new_full((len(edge), 1), _VISIBLE)
    visible = torch.cat([edge, enough], dim=-1).amin(-1)
    return permissive, tight[int((visible - 1e-2 * share.clamp(min=_LEGIBLE)).argmax())]


def openness(region: Region) -> tuple[Tensor, Tensor]:
    """Return how much of the action bounds is allowed, and how much of its edge each set makes.

    Both are means over directions from the anchor, so that they make sense in any dimension.

    Args:
        region: A region of batch shape ``(n,)``.

    Returns:
        The share of the way to the action bounds that is open, in (0, 1], ``(n,)``, and the share
        of directions in which each constraint is the one that ends the region, ``(n, K)``.
    """
    generator = torch.Generator().manual_seed(0)
    ray = torch.randn(_DIRECTIONS, 1, region.anchor.shape[-1], generator=generator)
    ray = ray.to(region.anchor)
    gauges = torch.stack(
        torch.broadcast_tensors(*(allowed.gauge(ray, region.anchor) for allowed in region.sets))
    )
    gauges = torch.where(region.is_active.movedim(-1, 0).unsqueeze(1), gauges, 0.0)
    outer, inner = gauges[0], gauges.amax(0)
    tight = 1 + 1e-4
    binds = (gauges[1:] * tight >= inner) & (gauges[1:] > outer * tight)
    return (outer / inner).mean(0), binds.double().mean(1).movedim(0, -1)
