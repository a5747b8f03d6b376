"""The density of a flow policy: over a grid of base samples, and its colors."""

from __future__ import annotations

import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from torch import Tensor

from cnfp_torchrl.visual.colors import INK, MUTED
from cnfp_torchrl.visual.snapshot import FlowSnapshot

COLORS = LinearSegmentedColormap.from_list(
    "density", ["#FFFFFF", "#F0ECF8", "#DAD1EC", "#BFB0DE", "#A18ECE", "#8570BC"]
)
"""White where rare, and light enough for samples and outlines to stand out everywhere."""

FILL, CURVE = "#DAD1EC", "#7A62B3"

BREAKS = "#B80F0A"
"""Samples outside the set so far; after the last stage, those that break any constraint."""

SPREAD = 3.2
"""How many standard deviations of the base the density is drawn over."""

_NODES = 161
_NODES_IN_ONE = 1201


def grid_latents(snapshot: FlowSnapshot) -> Tensor:
    """Return base samples on a grid around the base's mean: ``(n, n, 2)``, or ``(n, 1)``.

    Raises:
        ValueError: in more than two dimensions.
    """
    if snapshot.dim > 2:
        raise ValueError(f"snapshot: expected dimension 1 or 2 for a grid, given {snapshot.dim}")
    along = torch.linspace(-SPREAD, SPREAD, _NODES if snapshot.dim == 2 else _NODES_IN_ONE)
    unit = torch.stack(torch.meshgrid([along] * snapshot.dim, indexing="xy"), dim=-1)
    return snapshot.loc + snapshot.scale * unit


def base_log_density(snapshot: FlowSnapshot, latents: Tensor) -> Tensor:
    """Return the Gaussian base's log-density at latents ``(*batch, d)``."""
    standard = (latents - snapshot.loc) / snapshot.scale
    normalizer = snapshot.scale.log() + 0.5 * math.log(2 * math.pi)
    return -(standard.square() / 2 + normalizer).sum(-1)


def density_scale(snapshot: FlowSnapshot) -> Normalize:
    """Return one color scale for base and stages, from the bulk of the samples' log-densities."""
    drawn = [snapshot.latent_log_density, *(stage.log_density for stage in snapshot.stages)]
    values = torch.cat(drawn).double()
    values = values[values.isfinite()]
    if len(values) == 0:
        return Normalize(-1, 0)
    high = float(values.quantile(0.95))
    low = min(float(values.quantile(0.01)), high - 3)
    return Normalize(max(low, high - 7), high)


def draw_grid(axes: Axes, points: Tensor, log_density: Tensor, scale: Normalize) -> None:
    """Color a bent grid of points ``(rows, columns, 2)`` by the log-density at its nodes."""
    x, y = points.numpy()[..., 0], points.numpy()[..., 1]
    values = np.clip(log_density.nan_to_num(neginf=-1e6).numpy(), scale.vmin, scale.vmax)
    axes.pcolormesh(x, y, values, cmap=COLORS, norm=scale, shading="gouraud", zorder=1)


def draw_samples(axes: Axes, samples: Tensor, broken: Tensor | None = None) -> None:
    """Draw samples ``(n, 2)`` as dots, those that are broken in a color of warning."""
    broken = torch.zeros(len(samples), dtype=torch.bool) if broken is None else broken
    good, bad = samples[~broken].numpy(), samples[broken].numpy()
    axes.plot(*good.T, ".", color=INK, markersize=2.4, alpha=0.7, mew=0, zorder=3, label="samples")
    axes.plot(
        *bad.T, ".", color=BREAKS, markersize=3.2, alpha=0.9, mew=0, zorder=3, label="outside"
    )


def draw_scored_samples(
    axes: Axes, samples: Tensor, log_density: Tensor, scale: Normalize, broken: Tensor | None = None
) -> None:
    """Draw samples ``(n, 2)`` colored by their log-density ``(n,)``."""
    broken = torch.zeros(len(samples), dtype=torch.bool) if broken is None else broken
    x, y = samples[~broken].numpy().T
    colors = COLORS(scale(log_density[~broken].numpy()))
    axes.scatter(x, y, c=colors, s=8, linewidths=0.3, edgecolors=MUTED, zorder=3)
    axes.plot(*samples[broken].numpy().T, ".", color=BREAKS, markersize=4, mew=0, zorder=3)


def draw_rug(axes: Axes, samples: Tensor, level: float, broken: Tensor | None = None) -> None:
    """Draw samples ``(n, 1)`` of one component as ticks at a level."""
    broken = torch.zeros(len(samples), dtype=torch.bool) if broken is None else broken
    for chosen, color in ((~broken, INK), (broken, BREAKS)):
        at = samples[chosen, 0].numpy()
        axes.plot(at, np.full_like(at, level), "|", color=color, markersize=5, alpha=0.15)
