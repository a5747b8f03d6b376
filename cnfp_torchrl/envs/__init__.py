"""Transforms that publish an environment's constraints into the tensordict."""

from cnfp_torchrl.envs.action_guard import ActionGuard
from cnfp_torchrl.envs.anchor_transform import ConstraintAnchor
from cnfp_torchrl.envs.camera import Camera, can_render
from cnfp_torchrl.envs.constrain_env import constrain_env
from cnfp_torchrl.envs.constrained_actions import ConstrainedActions
from cnfp_torchrl.envs.cost import (
    ConstraintCost,
    Indicator,
    constraint_names,
    counted_constraints,
    refuse_misnamed_judges,
)
from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.envs.observed import (
    ObservedEntry,
    leaf_specs,
    observed_entries,
    refuse_changed_inputs,
)
from cnfp_torchrl.envs.packed_states import PackedStates
from cnfp_torchrl.envs.penalty import RewardPenalty
from cnfp_torchrl.envs.previous_action import PreviousAction
from cnfp_torchrl.envs.relaxation_watch import RelaxedEverywhereWarning
from cnfp_torchrl.envs.sampled_geometry import (
    SampledGeometry,
    amounts_keys,
    constraints_to_sample,
)
from cnfp_torchrl.envs.task_view import (
    NOTHING,
    Boxes,
    Component,
    Discs,
    Map,
    Marks,
    Polyline,
    Series,
    Shape,
    ShowTask,
    StateSetter,
    TaskView,
    action_components,
    environment_layers,
    find_task_view,
    numbered_components,
    require_names,
)

# Whoever has an environment in hand looks for these here.
from cnfp_torchrl.modules import appended_transforms, constraint_bijectors

__all__ = [
    "NOTHING",
    "ActionGuard",
    "Boxes",
    "Camera",
    "Component",
    "ConstrainedActions",
    "ConstraintAnchor",
    "ConstraintCost",
    "Discs",
    "GeometryTransform",
    "Indicator",
    "Map",
    "Marks",
    "ObservedEntry",
    "PackedStates",
    "Polyline",
    "PreviousAction",
    "RelaxedEverywhereWarning",
    "RewardPenalty",
    "SampledGeometry",
    "Series",
    "Shape",
    "ShowTask",
    "StateSetter",
    "TaskView",
    "action_components",
    "amounts_keys",
    "appended_transforms",
    "can_render",
    "constrain_env",
    "constraint_bijectors",
    "constraint_names",
    "constraints_to_sample",
    "counted_constraints",
    "environment_layers",
    "find_task_view",
    "leaf_specs",
    "numbered_components",
    "observed_entries",
    "refuse_changed_inputs",
    "refuse_misnamed_judges",
    "require_names",
]
