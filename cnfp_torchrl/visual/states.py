"""Two telling states of an environment: one that permits much and one where constraints bind."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.geometry import Region
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL
from cnfp_torchrl.visual.arena import layout_of

_DIRECTIONS = 256
_CANDIDATES = 1024
_MOST_RESETS = 64
_LOW = 30
"""Charges of up to this much above the battery's threshold are low, in percent."""
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

    Point navigation is reset to full batteries all over the map and to low ones beside the
    rectangles; any other environment is stepped at random, within the constraints.

    Args:
        env: with geometry, anchor and active flags; it is reset. A larger batch looks at more
            states.
        head: the flow module of an actor for it.
        steps: length of the random walk.
    """
    layout = layout_of(env)
    if layout is None:
        walk = env.rollout(steps, head.random, break_when_any_done=False).reshape(-1)
        full = low = walk
    else:
        full, low = _point_nav_states(env, layout)
    region = head.get_region(full)
    share, _ = openness(region)
    if region.active is not None:
        share = share * region.active.all(-1)
    permissive = full[int(share.argmax())]
    share, edge = openness(head.get_region(low))
    enough = edge.new_full((len(edge), 1), _VISIBLE)
    visible = torch.cat([edge, enough], dim=-1).amin(-1)
    return permissive, low[int((visible - 1e-2 * share.clamp(min=_LEGIBLE)).argmax())]


def openness(region: Region) -> tuple[Tensor, Tensor]:
    """Return how much of the action bounds is allowed, and how much of its edge each set makes.

    Both are means over directions from the anchor, so that they make sense in any dimension.

    Args:
        region: of batch shape ``(n,)``.

    Returns:
        The share of the way to the action bounds that is open, in (0, 1], ``(n,)``, and the share
        of directions in which each constraint is the one that ends the region, ``(n, K)``.
    """
    generator = torch.Generator().manual_seed(0)
    ray = torch.randn(_DIRECTIONS, 1, region.anchor.shape[-1], generator=generator)
    ray = ray.to(region.anchor)
    gauges = torch.stack(
        torch.broadcast_tensors(*(each.gauge(ray, region.anchor) for each in region.sets))
    )
    if region.active is not None:
        gauges = torch.where(region.active.movedim(-1, 0).unsqueeze(1), gauges, 0.0)
    outer, inner = gauges[0], gauges.amax(0)
    tight = 1 + 1e-4
    binds = (gauges[1:] * tight >= inner) & (gauges[1:] > outer * tight)
    return (outer / inner).mean(0), binds.double().mean(1).movedim(0, -1)


def _point_nav_states(env: EnvBase, layout: Layout) -> tuple[TensorDictBase, TensorDictBase]:
    """Return states with a full battery anywhere, and with low ones close beside a rectangle."""
    generator = torch.Generator().manual_seed(0)
    shape = env.batch_size
    lowest = layout.battery_threshold + 1
    highest = min(layout.battery_threshold + _LOW, BATTERY_FULL)
    full, low = [], []
    for _ in range(min(-(-_CANDIDATES // shape.numel()), _MOST_RESETS)):
        charge = torch.randint(lowest, highest + 1, shape, generator=generator)
        beside = _beside_rectangles(layout, shape, generator) if layout.rectangles else None
        full.append(env.reset(battery=BATTERY_FULL))
        low.append(env.reset(battery=charge, position=beside))
    permissive: TensorDictBase = torch.stack(full).reshape(-1)
    # The first of equally permissive states is taken: let it be far from everything.
    far = _clearance(layout, permissive["observation"][:, :2]).argsort(descending=True)
    return permissive[far], torch.stack(low).reshape(-1)


def _clearance(layout: Layout, position: Tensor) -> Tensor:
    """Return the distance to the nearest rectangle or wall along an axis, ``(n,)``."""
    clearance = layout.wall - position.abs().amax(-1)
    for rectangle in layout.rectangles:
        low, high = torch.tensor(rectangle).to(position).split(2)
        outside = torch.maximum(low - position, position - high).amax(-1)
        clearance = torch.minimum(clearance, outside)
    return clearance


def _beside_rectangles(layout: Layout, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Return positions at up to 0.8 steps from a rectangle, ``(*shape, 2)``."""

    def uniform(*size: int) -> Tensor:
        return torch.rand(*shape, *size, generator=generator)

    chosen = torch.randint(len(layout.rectangles), shape, generator=generator)
    low, high = torch.tensor(layout.rectangles)[chosen].split(2, dim=-1)
    margin = layout.step_length * (0.1 + 0.7 * uniform(1))
    low, high = low - margin, high + margin
    position = low + (high - low) * uniform(2)
    # Push one component, either, onto either side of the grown rectangle.
    upper = (uniform(1) < 0.5).expand_as(position)
    on_first = uniform(1) < 0.5
    pushed = torch.cat([on_first, ~on_first], dim=-1)
    position = torch.where(pushed, torch.where(upper, high, low), position)
    return position.clamp(-layout.wall, layout.wall)
