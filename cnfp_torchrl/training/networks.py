"""Networks of actor and critic, from TorchRL's building blocks."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator


def gaussian_network(
    observation_size: int,
    action_size: int,
    *,
    hidden: Sequence[int] = (256, 256),
    scale_mapping: str = "biased_softplus_1.0",
    scale_lb: float = 1e-4,
) -> nn.Module:
    """Return a network from observations to location and scale of a Gaussian over latents.

    Args:
        observation_size: number of observed numbers.
        action_size: number d of action components.
        hidden: widths of the hidden layers.
        scale_mapping: map to a positive scale, see `torchrl.modules.NormalParamExtractor`.
        scale_lb: lower bound of the scale.
    """
    return nn.Sequential(
        MLP(
            in_features=observation_size,
            out_features=2 * action_size,
            num_cells=list(hidden),
            activation_class=nn.ReLU,
        ),
        NormalParamExtractor(scale_mapping=scale_mapping, scale_lb=scale_lb),
    )


def action_value_network(
    observation_size: int, action_size: int, *, hidden: Sequence[int] = (256, 256)
) -> ValueOperator:
    """Return a critic of ``observation`` and ``action`` that writes ``state_action_value``."""
    network = MLP(
        in_features=observation_size + action_size,
        out_features=1,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
    )
    return ValueOperator(network, in_keys=["observation", "action"])


def action_cost_network(
    observation_size: int,
    action_size: int,
    constraints: int,
    *,
    hidden: Sequence[int] = (256, 256),
) -> TensorDictModule:
    """Return a critic of ``observation`` and ``action`` that writes ``state_action_cost`` > 0.

    Args:
        observation_size: number of observed numbers.
        action_size: number d of action components.
        constraints: number K of outputs.
        hidden: widths of the hidden layers.
    """
    network = MLP(
        in_features=observation_size + action_size,
        out_features=constraints,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
    )
    # Costs are not negative: an actor would exploit a critic that promised less than none.
    network.append(nn.Softplus())
    return TensorDictModule(network, ["observation", "action"], ["state_action_cost"])
