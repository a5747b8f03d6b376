"""Our parts in the groups of TorchRL's configuration system, for its own trainers.

Importing this module registers them in Hydra's store, beside those that
`torchrl.trainers.algorithms.configs` registers (``experiments/examples/torchrl_trainer.py``):

| group | name | makes |
|---|---|---|
| ``env`` | ``constrained`` | `cnfp_torchrl.constrain_env` |
| ``transform`` | ``action_guard`` | `cnfp_torchrl.envs.ActionGuard` |
| ``transform`` | ``constrained_actions`` | `cnfp_torchrl.envs.ConstrainedActions` |
| ``transform`` | ``constraint_cost`` | `cnfp_torchrl.envs.ConstraintCost` |
| ``transform`` | ``reward_penalty`` | `cnfp_torchrl.envs.RewardPenalty` |
| ``model`` | ``constrained_actor`` | `cnfp_torchrl.make_constrained_actor` |
| ``loss`` | ``constrained_sac`` | `cnfp_torchrl.objectives.ConstrainedSACLoss` |
| ``logger`` | ``rerun`` | `cnfp_torchrl.visual.rerun.RerunLogger` |

A geometry is a transform of one's own, named by ``_target_``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import NormalParamExtractor, SafeProbabilisticTensorDictSequential
from torchrl.trainers.algorithms.configs.envs import EnvConfig
from torchrl.trainers.algorithms.configs.logging import LoggerConfig
from torchrl.trainers.algorithms.configs.modules import ModelConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from cnfp_torchrl.envs import GeometryTransform, constrain_env
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.objectives import ConstrainedSACLoss


def make_constrained_env(
    base_env: EnvBase,
    geometries: Sequence[GeometryTransform],
    order: Sequence[str] | None = None,
    transforms: Sequence[Any] = (),
) -> EnvBase:
    """Return an environment of `constrain_env`, with further transforms behind.

    Args:
        base_env: The environment.
        geometries: One transform for each constraint.
        order: The constraints' names in order of application; None takes that of the geometries.
        transforms: Transforms to append, such as an `ActionGuard`.
    """
    env = constrain_env(base_env, *geometries, order=None if order is None else list(order))
    for transform in transforms:
        env.append_transform(transform)
    return env


def make_actor(
    network: nn.Module | Callable[[], nn.Module],
    env: EnvBase | Callable[[], EnvBase],
    in_keys: Sequence[str] | None = None,
    flow: str = "exact",
    return_log_prob: bool = False,
    **unused: Any,
) -> SafeProbabilisticTensorDictSequential:
    """Return a constrained actor for an environment.

    TorchRL's trainers build an actor for the collector and another one for the loss, and copy the
    weights from one to the other.

    Args:
        network: A map from what `in_keys` name to 2 d numbers, of which location and scale are
            made, or what makes one.
        env: A constrained environment, or what makes one; it is not stepped.
        in_keys: The keys of what the network reads; None means the observation.
        flow: The rule that combines the sets.
        return_log_prob: Whether to write the action's log-density, too.
        unused: Fields that TorchRL gives to all models.
    """
    env = env if isinstance(env, EnvBase) else env()
    network = network if isinstance(network, nn.Module) else network()
    return make_constrained_actor(
        nn.Sequential(network, NormalParamExtractor()),
        env,
        in_keys=("observation",) if in_keys is None else tuple(in_keys),
        flow=flow,
        return_log_prob=return_log_prob,
    )


def make_loss(
    actor_network: SafeProbabilisticTensorDictSequential, qvalue_network: Any, **options: Any
) -> ConstrainedSACLoss:
    """Return the loss of a constrained actor; options that are None take the loss's defaults.

    Args:
        actor_network: A constrained actor.
        qvalue_network: A critic.
        options: Options of `ConstrainedSACLoss`.
    """
    given = {name: value for name, value in options.items() if value is not None}
    return ConstrainedSACLoss(
        actor_network,
        qvalue_network,
        action_spec=actor_network[-1].spec[actor_network[-1].action_key],
        **given,
    )


@dataclass
class ConstrainedEnvConfig(EnvConfig):
    """Configuration of `make_constrained_env`."""

    base_env: Any = MISSING
    geometries: list[Any] = MISSING
    order: list[str] | None = None
    transforms: list[Any] = field(default_factory=list)
    _target_: str = f"{__name__}.make_constrained_env"


@dataclass
class ActionGuardConfig(TransformConfig):
    """Configuration of `cnfp_torchrl.envs.ActionGuard`."""

    refuse_relaxation: bool = False
    _target_: str = "cnfp_torchrl.envs.ActionGuard"


@dataclass
class ConstrainedActionsConfig(TransformConfig):
    """Configuration of `cnfp_torchrl.envs.ConstrainedActions`."""

    flow: Any = "exact"
    unbounded: bool = False
    _target_: str = "cnfp_torchrl.envs.ConstrainedActions"


@dataclass
class ConstraintCostConfig(TransformConfig):
    """Configuration of `cnfp_torchrl.envs.ConstraintCost`."""

    indicators: dict[str, Any] | None = None
    _target_: str = "cnfp_torchrl.envs.ConstraintCost"


@dataclass
class RewardPenaltyConfig(TransformConfig):
    """Configuration of `cnfp_torchrl.envs.RewardPenalty`."""

    penalty: float = 100.0
    _target_: str = "cnfp_torchrl.envs.RewardPenalty"


@dataclass
class ConstrainedActorConfig(ModelConfig):
    """Configuration of `make_actor`."""

    network: Any = MISSING
    env: Any = MISSING
    flow: Any = "exact"
    return_log_prob: bool = False
    _target_: str = f"{__name__}.make_actor"


@dataclass
class ConstrainedSACLossConfig(LossConfig):
    """Configuration of `make_loss`; what is None takes the loss's own default."""

    actor_network: Any = None
    qvalue_network: Any = None
    entropy: str | None = None
    gamma: float | None = None
    max_alpha: float | None = None
    alpha_init: float | None = None
    target_entropy: Any = None
    num_qvalue_nets: int | None = None
    _target_: str = f"{__name__}.make_loss"


@dataclass
class RerunLoggerConfig(LoggerConfig):
    """Configuration of `cnfp_torchrl.visual.rerun.RerunLogger`."""

    exp_name: str = MISSING
    log_dir: str = MISSING
    _target_: str = "cnfp_torchrl.visual.rerun.RerunLogger"


_GROUPS: dict[str, dict[str, type[Any]]] = {
    "env": {"constrained": ConstrainedEnvConfig},
    "transform": {
        "action_guard": ActionGuardConfig,
        "constrained_actions": ConstrainedActionsConfig,
        "constraint_cost": ConstraintCostConfig,
        "reward_penalty": RewardPenaltyConfig,
    },
    "model": {"constrained_actor": ConstrainedActorConfig},
    "loss": {"constrained_sac": ConstrainedSACLossConfig},
    "logger": {"rerun": RerunLoggerConfig},
}

for _group, _nodes in _GROUPS.items():
    for _name, _node in _nodes.items():
        ConfigStore.instance().store(group=_group, name=_name, node=_node)
