"""Environment, actor, critics and loss of a run, assembled from its configuration."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from math import inf
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Bounded
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
    ScaledNetwork,
    action_bounds,
    make_constrained_actor,
    publishes_constraints,
    require_fit,
)
from cnfp_torchrl.objectives import SACLagrangianLoss
from cnfp_torchrl.training.run_folder import RunFolder

_LARGE = 10.0
"""Observations beyond it are better scaled."""
_WITHOUT_END = 1e9
"""Bounds beyond it, such as the largest float32 of Gymnasium's, are none."""


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
        network = _scaled(network, env, given)
    return network if env.device is None else network.to(env.device)


def warn_of_large_observations(config: DictConfig, env: TransformedEnv) -> None:
    """Warn where observations reach far beyond 1 by their spec, and nothing scales them."""
    spec = env.observation_spec.get(OBSERVATION_KEY, None)
    if not isinstance(spec, Bounded) or config.network.get("observation_scale") is not None:
        return
    reach = torch.maximum(spec.space.low.abs(), spec.space.high.abs())
    reach = reach.reshape(-1, spec.shape[-1]).amax(0)
    reach = torch.where(reach > _WITHOUT_END, 0.0, reach)
    largest = float(reach.max())
    if largest > _LARGE:
        scale = ",".join(f"{x:.3g}" if x > 0 else "1" for x in reach.tolist())
        warnings.warn(
            f"observations reach {largest:.3g}, and networks learn best from numbers around 1; to "
            f"scale what networks read, and not what geometries do: network.observation_scale="
            f"[{scale}], or observation_scale in the task's YAML file",
            stacklevel=2,
        )


def _scaled(network: nn.Module, env: TransformedEnv, given: Sequence[float]) -> nn.Module:
    """Return a network before which observations, and actions of critics, are scaled.

    Raises:
        ValueError: when there is not one number > 0 for each component of the observation.
    """
    size, _ = _sizes(env)
    scale = list(given)
    if len(scale) != size or not all(isinstance(x, int | float) and 0 < x < inf for x in scale):
        raise ValueError(
            f"network.observation_scale: expected a finite number > 0 for each of the {size} "
            f"components of the observation, given {scale}"
        )
    if not isinstance(network, TensorDictModule):
        return ScaledNetwork(scale, network)
    bounds = action_bounds(env.full_action_spec, env.action_key)
    by_key = {OBSERVATION_KEY: scale, env.action_key: ((bounds.high - bounds.low) / 2).tolist()}
    scales = [x for key in network.in_keys for x in by_key[key]]
    network.module = ScaledNetwork(scales, network.module)
    return network


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
