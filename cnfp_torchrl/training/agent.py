"""Environment, actor, critics and loss of a run, assembled from its configuration."""

from __future__ import annotations

from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, ParallelEnv, RewardSum, TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential, ValueOperator
from torchrl.objectives import LossModule

from cnfp_torchrl.envs import (
    ConstraintAnchor,
    GeometryTransform,
    RewardPenalty,
    ShowTask,
    constrain_env,
    counted_constraints,
)
from cnfp_torchrl.keys import OBSERVATION_KEY
from cnfp_torchrl.modules import (
    Flow,
    make_constrained_actor,
    publishes_constraints,
    require_fit,
)
from cnfp_torchrl.objectives import SACLagrangianLoss
from cnfp_torchrl.training.observation_scale import scaled
from cnfp_torchrl.training.run_folder import RunFolder


def build_environment(
    config: DictConfig,
    *,
    batch_size: list[int] | None = None,
    device: torch.device | str | None = None,
    with_anchor: bool = False,
    with_penalty: bool = False,
    compile: bool = False,
) -> TransformedEnv:
    """Return the environment of a configuration.

    Args:
        config: The configuration with the sections ``env`` and ``flow``.
        batch_size: The batch size of environments that have one; None takes that of the
            configuration.
        device: The device of the environment, and of the actor and the critics made for it; None
            leaves it where it is.
        with_anchor: Whether to publish anchor and active flags also where the flow does not need
            them.
        with_penalty: Whether to subtract the penalty of ``env.penalty``, which is for training
            alone: policies are judged on the reward without it.
        compile: Whether to compute geometry and anchor of a step by a compiled function, where
            there is an anchor (`constrain_env`).

    Raises:
        ValueError: when a geometry is null or has another name than its key, and when there is none
            for a flow that guarantees constraints.
    """
    replaced: dict[str, Any] = {}
    if batch_size is not None and "batch_size" in config.env.base:
        replaced["batch_size"] = batch_size
    base: EnvBase = instantiate(config.env.base, **replaced, _convert_="all")
    bare = base.base_env if isinstance(base, TransformedEnv) else base
    if replaced and isinstance(bare, ParallelEnv):
        # Each of its environments is a process: no more of them than in training. None has begun.
        base.close(raise_if_closed=False)
        base = instantiate(config.env.base, _convert_="all")
    if device is not None:
        base = base.to(device)
    env = TransformedEnv(base, RewardSum(), auto_unwrap=True)
    view = instantiate(config.env.get("view"), _convert_="all")
    if view is not None:
        env.append_transform(ShowTask(view))
    penalty = _penalty(config) if with_penalty else None
    if penalty is not None:  # behind the sum, which is of the reward without it
        env.append_transform(penalty)
    geometries = _geometries(config)
    flow: Flow = instantiate(config.flow)
    if not geometries:
        if flow.is_safe:
            env.close(raise_if_closed=False)
            raise ValueError(
                f"env.geometry: expected at least one constraint for {type(flow).__name__} to keep "
                "to, given none; name its set there, or train with flow=unconstrained"
            )
        # Without constraints the anchor is the middle of the bounds, from which pictures look.
        return env.append_transform(ConstraintAnchor([])) if with_anchor else env
    order = config.env.get("order")
    with_anchor = with_anchor or flow.is_safe
    return constrain_env(
        env,
        *geometries,
        order=None if order is None else list(order),
        with_anchor=with_anchor,
        compile=compile and with_anchor,
    )


def training_environment(config: DictConfig) -> TransformedEnv:
    """Return the environment that a run trains in, compiled if the run is."""
    return build_environment(
        config, device=config.device, with_penalty=True, compile=config.compile
    )


def _geometries(config: DictConfig) -> list[GeometryTransform]:
    """Return the transforms that publish the constraints, in the order of the configuration."""
    geometries = []
    for name, section in (config.env.get("geometry") or {}).items():
        if section is None:
            raise ValueError(
                f"env.geometry.{name}: expected a _target_, given null; leave a constraint out by "
                f"~env.geometry.{name}"
            )
        geometry = instantiate(section, _convert_="all")
        if geometry.name != name:
            raise ValueError(
                f"env.geometry.{name}.name: expected '{name}', given '{geometry.name}'"
            )
        geometries.append(geometry)
    return geometries


def _penalty(config: DictConfig) -> RewardPenalty | None:
    """Return what violations cost in training; a number serves as well, and 0 is none."""
    penalty = config.env.get("penalty")
    if isinstance(penalty, int | float):
        return RewardPenalty(penalty) if penalty else None
    return instantiate(penalty)


def build_actor(config: DictConfig, env: TransformedEnv) -> SafeProbabilisticTensorDictSequential:
    """Return the actor of a configuration for an environment.

    Raises:
        ValueError: when its network does not fit the environment.
    """
    flow: Flow = instantiate(config.flow)
    network = _made(config, "actor", env)
    if flow.reads_constraints or publishes_constraints(env):
        return make_constrained_actor(network, env, flow=flow)
    return make_constrained_actor(network, bijectors=[], spec=env.action_spec_unbatched, flow=flow)


def _made(config: DictConfig, name: str, env: TransformedEnv, *sizes: int) -> Any:
    """Return a network of a configuration, on the environment's device."""
    network = instantiate(config.network[name], *_sizes(env), *sizes)
    if (given := config.network.get("observation_scale")) is not None:
        network = scaled(network, env, given)
    return network if env.device is None else network.to(env.device)


def _sizes(env: TransformedEnv) -> tuple[int, int]:
    """Return the numbers of observed numbers and of action components.

    Raises:
        ValueError: when the environment observes no vector.
    """
    spec = env.observation_spec.get(OBSERVATION_KEY, None)
    if spec is None or spec.ndim != len(env.batch_size) + 1 or not spec.dtype.is_floating_point:
        kinds = {str(key): tuple(spec.shape) for key, spec in env.observation_spec.items()}
        raise ValueError(
            f"env.base: expected an environment that publishes a vector of floating numbers at "
            f"{OBSERVATION_KEY!r}, given one that publishes {kinds}; concatenate what the networks "
            "are to read with torchrl.envs.CatTensors(in_keys=[...], out_key='observation', "
            "del_keys=False, sort=False)"
        )
    return spec.shape[-1], env.action_spec_unbatched.shape[-1]


def build_critic(config: DictConfig, env: TransformedEnv) -> ValueOperator:
    """Return the critic of a configuration for an environment."""
    critic = _made(config, "critic", env)
    require_fit("network.critic", critic, env, critic.out_keys[-1:], 1)
    return critic


def _require_output(critic: TensorDictModule, key: NestedKey) -> None:
    """Refuse a critic that writes another entry than a loss reads.

    Raises:
        ValueError: naming both.
    """
    if key not in critic.out_keys:
        raise ValueError(
            f"network.critic: expected one that writes {key!r}, as the loss reads it, given one "
            f"that writes {critic.out_keys}; algorithm=sac, td3 and ppo bring networks that fit"
        )


def build_cost_critic(config: DictConfig, env: TransformedEnv) -> TensorDictModule:
    """Return the critic of the costs that an environment counts."""
    constraints = len(counted_constraints(env))
    critic = _made(config, "cost_critic", env, constraints)
    require_fit("network.cost_critic", critic, env, critic.out_keys[-1:], constraints)
    return critic


def build_loss(
    config: DictConfig, env: TransformedEnv, actor: SafeProbabilisticTensorDictSequential
) -> LossModule:
    """Return the loss of a configuration, with critics of its own for the actor.

    Raises:
        ValueError: when the loss needs costs and the environment counts none.
    """
    make = instantiate(config.loss, _partial_=True)
    critic = build_critic(config, env)
    networks: list[TensorDictModule] = [actor, critic]
    kind = make.func
    default_keys: Any = getattr(kind, "default_keys", None)
    if default_keys is not None:
        keys = default_keys()
        is_of_states = not hasattr(keys, "state_action_value")
        _require_output(critic, keys.value if is_of_states else keys.state_action_value)
    options: dict[str, Any] = {}
    if isinstance(kind, type) and issubclass(kind, SACLagrangianLoss):
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
        folder: The run.
        config: The run's configuration, from `RunFolder.load_config`.
        env: An environment of that configuration.

    Raises:
        ValueError: when the run's checkpoint is not that of such an actor.
    """
    actor = build_actor(config, env)
    folder.restore(actor=actor)
    return actor.eval()
