"""Figures of flow policies and of runs, painted by matplotlib and without a window."""

from cnfp_torchrl.visual.figures.learning_curves import learning_curves, read_scalars
from cnfp_torchrl.visual.figures.run_figures import draw_run_figures
from cnfp_torchrl.visual.figures.stages import flow_stages
from cnfp_torchrl.visual.figures.trajectories import Episode, record_episodes, trajectories

__all__ = [
    "Episode",
    "draw_run_figures",
    "flow_stages",
    "learning_curves",
    "read_scalars",
    "record_episodes",
    "trajectories",
]
