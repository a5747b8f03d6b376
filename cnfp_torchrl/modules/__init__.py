"""TensorDictModules that give actors hard action constraints."""

from cnfp_torchrl.keys import MissingGeometryError
from cnfp_torchrl.modules.action_bounds import ActionBounds, action_bounds, refuse_other_bounds
from cnfp_torchrl.modules.actors import (
    actor_modules,
    constrain,
    flow_head,
    has_density,
    make_constrained_actor,
    with_reference_entropy,
)
from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector, in_order
from cnfp_torchrl.modules.exploration import refuse_exploration
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule, LostDensityWarning
from cnfp_torchrl.modules.flows import (
    ExactFlow,
    Flow,
    GaugeFlow,
    ProjectionFlow,
    RadialFlow,
    RecessionFlow,
    SoftFlow,
    SquashFlow,
    UnconstrainedFlow,
    resolve_safe_flow,
)
from cnfp_torchrl.modules.free_actions import FreeActionMap
from cnfp_torchrl.modules.guard import (
    ConstraintViolationError,
    ExecutedActionGuard,
    RelaxedConstraintError,
    guarded,
    refuse_misfit,
    refuse_relaxed,
    refuse_violations,
)
from cnfp_torchrl.modules.latent import FlowMap, LatentActor, split_at_latent
from cnfp_torchrl.modules.layer import ConstraintLayer
from cnfp_torchrl.modules.network_fit import require_fit
from cnfp_torchrl.modules.parameter_network import ParameterNetwork
from cnfp_torchrl.modules.publisher import (
    ConstraintPublisher,
    appended_transforms,
    changed_actions,
    constraint_bijectors,
    publishes_constraints,
)
from cnfp_torchrl.modules.random_policy import SafeRandomLatents, SafeRandomPolicy
from cnfp_torchrl.modules.scaled_network import ScaledNetwork
from cnfp_torchrl.modules.warm_up import WarmUpPolicy

__all__ = [
    "ActionBounds",
    "ConstrainedFlowModule",
    "ConstraintBijector",
    "ConstraintLayer",
    "ConstraintPublisher",
    "ConstraintViolationError",
    "ExactFlow",
    "ExecutedActionGuard",
    "Flow",
    "FlowMap",
    "FreeActionMap",
    "GaugeFlow",
    "LatentActor",
    "LostDensityWarning",
    "MissingGeometryError",
    "ParameterNetwork",
    "ProjectionFlow",
    "RadialFlow",
    "RecessionFlow",
    "RelaxedConstraintError",
    "SafeRandomLatents",
    "SafeRandomPolicy",
    "ScaledNetwork",
    "SoftFlow",
    "SquashFlow",
    "UnconstrainedFlow",
    "WarmUpPolicy",
    "action_bounds",
    "actor_modules",
    "appended_transforms",
    "changed_actions",
    "constrain",
    "constraint_bijectors",
    "flow_head",
    "guarded",
    "has_density",
    "in_order",
    "make_constrained_actor",
    "publishes_constraints",
    "refuse_exploration",
    "refuse_misfit",
    "refuse_other_bounds",
    "refuse_relaxed",
    "refuse_violations",
    "require_fit",
    "resolve_safe_flow",
    "split_at_latent",
    "with_reference_entropy",
]
