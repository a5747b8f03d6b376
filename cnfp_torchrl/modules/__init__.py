"""TensorDictModules that give actors hard action constraints."""

from cnfp_torchrl.modules.actors import (
    constrain,
    flow_head,
    has_density,
    make_constrained_actor,
    with_reference_entropy,
)
from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector, MissingGeometryError
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule
from cnfp_torchrl.modules.flows import (
    ExactFlow,
    Flow,
    GaugeFlow,
    ProjectionFlow,
    RadialFlow,
    SquashFlow,
    UnconstrainedFlow,
)
from cnfp_torchrl.modules.guard import ConstraintViolationError, ExecutedActionGuard, guarded
from cnfp_torchrl.modules.latent import FlowMap, LatentActor, split_at_latent
from cnfp_torchrl.modules.random_policy import SafeRandomPolicy, WarmUpPolicy

__all__ = [
    "ConstrainedFlowModule",
    "ConstraintBijector",
    "ConstraintViolationError",
    "ExactFlow",
    "ExecutedActionGuard",
    "Flow",
    "FlowMap",
    "GaugeFlow",
    "LatentActor",
    "MissingGeometryError",
    "ProjectionFlow",
    "RadialFlow",
    "SafeRandomPolicy",
    "SquashFlow",
    "UnconstrainedFlow",
    "WarmUpPolicy",
    "constrain",
    "flow_head",
    "guarded",
    "has_density",
    "make_constrained_actor",
    "split_at_latent",
    "with_reference_entropy",
]
