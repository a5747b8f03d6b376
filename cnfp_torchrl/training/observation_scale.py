"""The scale of what networks read, and not of what geometries do: ``observation_scale``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from math import inf

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv

from cnfp_torchrl.keys import OBSERVATION_KEY
from cnfp_torchrl.modules import ScaledNetwork, action_bounds

_LARGE = 10.0
"""Observations beyond it are better scaled."""
_WITHOUT_END = 1e9
"""Bounds beyond it, such as the largest float32 of Gymnasium's, are none."""


def warn_of_large_observations(config: DictConfig, env: TransformedEnv) -> None:
    """Warn where observations reach far beyond 1 by their spec, and nothing scales them.

    Args:
        config: The configuration, with the section ``network``.
        env: The environment of the configuration.
    """
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


def scaled(network: nn.Module, env: TransformedEnv, given: Sequence[float]) -> nn.Module:
    """Return a network before which observations, and actions of critics, are scaled.

    Args:
        network: The network, of an actor or a critic.
        env: The environment, which observes a vector.
        given: The number by which each component of the observation is divided.

    Raises:
        ValueError: when there is not one number > 0 for each component of the observation.
    """
    size = env.observation_spec[OBSERVATION_KEY].shape[-1]
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
