"""The panel of the base: the Gaussian before any stage of the flow."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from cnfp_torchrl.visual.density import (
    CURVE,
    FILL,
    SPREAD,
    base_log_density,
    draw_grid,
    draw_rug,
    draw_samples,
    draw_scored_samples,
    grid_latents,
)
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stage_panels import draw_path


def draw_base(axes: Axes, snapshot: FlowSnapshot, scale: Normalize) -> None:
    """Draw the Gaussian base, in one or in the first two of its components.

    Args:
        axes: an empty panel.
        snapshot: the policy in a state.
        scale: of the log-density's colors.
    """
    if snapshot.dim == 1:
        _draw_curve(axes, snapshot)
        return
    if snapshot.dim == 2:
        latents = grid_latents(snapshot)
        draw_grid(axes, latents, base_log_density(snapshot, latents), scale)
        draw_samples(axes, snapshot.latents)
    else:
        draw_scored_samples(axes, snapshot.latents[:, :2], snapshot.latent_log_density, scale)
    draw_path(axes, snapshot.latents[snapshot.followed, :2].unsqueeze(0).numpy())
    followed = snapshot.latents[snapshot.followed, :2] - snapshot.loc[:2]
    reach = max(SPREAD * float(snapshot.scale[:2].max()), 1.06 * float(followed.abs().max()))
    x, y = snapshot.loc[:2].tolist()
    axes.set_xlim(x - reach, x + reach)
    axes.set_ylim(y - reach, y + reach)
    axes.set_aspect("equal")


def _draw_curve(axes: Axes, snapshot: FlowSnapshot) -> None:
    latents = grid_latents(snapshot)
    density = base_log_density(snapshot, latents).exp().numpy()
    z, top = latents[:, 0].numpy(), float(density.max())
    axes.fill_between(z, density, color=FILL, zorder=1)
    axes.plot(z, density, color=CURVE, linewidth=1.4, zorder=2)
    draw_rug(axes, snapshot.latents, -0.03 * top)
    draw_path(axes, np.array([[snapshot.latents[snapshot.followed, 0], 0.0]], dtype=np.float32))
    axes.set_ylim(-0.1 * top, 1.05 * top)
