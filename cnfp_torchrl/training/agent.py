"""Environment, actor, critics and loss of a run, assembled from its configuration."""

from __future__ import annotations

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase, ParallelEnv, TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential, ValueOperator

from cnfp_torchrl.envs import RewardPenalty, constraint_bijectors
from cnfp_torchrl.modules import Flow, make_constrained_actor
from cnfp_torchrl.objectives import ConstrainedSACLoss, SACLagrangianLoss
from cnfp_torchrl.training.environment import counted_constraints, make_environment
from cnfp_torchrl.training.run_folder import RunFolder


def build_environment(
    config: DictConfig,
    *,
    batch_size: list[int] | None = None,
    with_anchor: bool = False,
    with_penalty: bool = False,
) -> TransformedEnv:
    """Return the environment of a configuration.

    Args:
        config: configuration with the sections ``env`` and ``flow``.
        batch_size: batch size of environments that have one; None takes that of the configuration.
        with_anchor: publish anchor and active flags also where the flow does not need them.
        with_penalty: subtract the penalty of ``env.penalty``, which is for training alone: policies
            are judged on the reward without it.
    """
    flow: Flow = instantiate(config.flow)
    replaced: dict[str, Any] = {}
    if batch_size is not None and "batch_size" in config.env.base:
        replaced["batch_size"] = batch_size
    base: EnvBase = instantiate(config.env.base, **replaced, _convert_="all")
    bare = base.base_env if isinstance(base, TransformedEnv) else base
    if replaced and isinstance(bare, ParallelEnv):
        base.close()  # each of its environments is a process: no more of them than in training
        base = instantiate(config.env.base, _convert_="all")
    return make_environment(
        base,
        {
            name: instantiate(section, _convert_="all")
            for name, section in config.env.geometry.items()
        },
        order=application_order(config),
        with_anchor=with_anchor or flow.is_safe,
        penalty=_penalty(config) if with_penalty else None,
    )


def _penalty(config: DictConfig) -> RewardPenalty | None:
    """Return what violations cost in training; a number serves as well, and 0 is none."""
    penalty = config.env.get("penalty")
    if isinstance(penalty, int | float):
        return RewardPenalty(penalty) if penalty else None
    return instantiate(penalty)


def application_order(config: DictConfig) -> list[str]:
    """Return the constraints in order of application: ``env.order``, else that of the geometry."""
    return list(config.env.get("order", config.env.geometry))


def build_actor(config: DictConfig, env: TransformedEnv) -> SafeProbabilisticTensorDictSequential:
    """Return the actor of a configuration for an environment."""
    observation_size = env.observation_spec["observation"].shape[-1]
    action_size = env.action_spec_unbatched.shape[-1]
    return make_constrained_actor(
        instantiate(config.network.actor, observation_size, action_size),
        bijectors=constraint_bijectors(env) if config.env.geometry else [],
        spec=env.action_spec_unbatched,
        order=application_order(config),
        flow=instantiate(config.flow),
    )


def build_critic(config: DictConfig, env: TransformedEnv) -> ValueOperator:
    """Return the critic of a configuration for an environment."""
    observation_size = env.observation_spec["observation"].shape[-1]
    action_size = env.action_spec_unbatched.shape[-1]
    return instantiate(config.network.critic, observation_size, action_size)


def build_cost_critic(config: DictConfig, env: TransformedEnv) -> TensorDictModule:
    """Return the critic of the costs that an environment counts."""
    observation_size = env.observation_spec["observation"].shape[-1]
    action_size = env.action_spec_unbatched.shape[-1]
    constraints = len(counted_constraints(env))
    return instantiate(config.network.cost_critic, observation_size, action_size, constraints)


def build_loss(
    config: DictConfig, env: TransformedEnv, actor: SafeProbabilisticTensorDictSequential
) -> ConstrainedSACLoss:
    """Return the loss of a configuration, with critics of its own for the actor.

    Raises:
        ValueError: when the loss needs costs and the environment counts none.
    """
    make = instantiate(config.loss, _partial_=True)
    networks: list[TensorDictModule] = [actor, build_critic(config, env)]
    options: dict[str, Any] = {"action_spec": env.action_spec_unbatched}
    if isinstance(make.func, type) and issubclass(make.func, SACLagrangianLoss):
        options["constraint_names"] = counted_constraints(env)
        if not options["constraint_names"]:
            raise ValueError(
                "loss: expected an environment that counts costs, given one without; append a "
                "ConstraintCost, or take loss=sac"
            )
        networks.append(build_cost_critic(config, env))
    return make(*networks, **options)


def load_actor(
    folder: RunFolder, config: DictConfig, env: TransformedEnv
) -> SafeProbabilisticTensorDictSequential:
    """Return the trained actor of a run.

    Args:
        folder: the run.
        config: the run's configuration, from `RunFolder.load_config`.
        env: an environment of that configuration.

    Raises:
        ValueError: when the run's checkpoint is not that of such an actor.
    """
    actor = build_actor(config, env)
    folder.restore(actor=actor)
    return actor.eval()
