"""What a flow policy does in a step: as values, as arrays, and in pictures.

Nothing here draws; `cnfp_torchrl.visual.figures` paints with matplotlib and
`cnfp_torchrl.visual.rerun` for Rerun's viewer.
"""

from cnfp_torchrl.visual.colors import constraint_colors
from cnfp_torchrl.visual.explanation import Explanation, explain
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.scene import Scene
from cnfp_torchrl.visual.setting import Setting
from cnfp_torchrl.visual.snapshot import FlowSnapshot, Stage, take_snapshot
from cnfp_torchrl.visual.states import telling_states

__all__ = [
    "Explanation",
    "FlowSnapshot",
    "Scene",
    "Setting",
    "Stage",
    "constraint_colors",
    "explain",
    "replay_step",
    "take_snapshot",
    "telling_states",
]
