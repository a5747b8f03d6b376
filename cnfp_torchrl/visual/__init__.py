"""Pictures of flow policies and of runs, drawn with matplotlib and without a window."""

from cnfp_torchrl.visual.colors import constraint_colors
from cnfp_torchrl.visual.flow_stages import flow_stages
from cnfp_torchrl.visual.learning_curves import learning_curves, read_scalars
from cnfp_torchrl.visual.run_figures import draw_run_figures
from cnfp_torchrl.visual.snapshot import FlowSnapshot, Stage, take_snapshot
from cnfp_torchrl.visual.states import telling_states
from cnfp_torchrl.visual.trajectories import Episode, record_episodes, trajectories

__all__ = [
    "Episode",
    "FlowSnapshot",
    "Stage",
    "constraint_colors",
    "draw_run_figures",
    "flow_stages",
    "learning_curves",
    "read_scalars",
    "record_episodes",
    "take_snapshot",
    "telling_states",
    "trajectories",
]
