"""Networks of actor and critic, from TorchRL's building blocks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
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
        observation_size: The number of observed numbers.
        action_size: The number d of action components.
        hidden: Widths of the hidden layers.
        scale_mapping: The map to a positive scale, see `torchrl.modules.NormalParamExtractor`.
        scale_lb: The lower bound of the scale.
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


class LatentLocation(nn.Module):
    """The end of a deterministic network: a location within reach, and a scale that is not learned.

    Beyond a few units of the latent an action hardly changes, so that a location without bounds
    would run away from where it has gradients.

    Args:
        noise: The scale, that of exploration, in units of the latent.
        reach: The largest absolute value of a location.
    """

    def __init__(self, noise: float, reach: float) -> None:
        super().__init__()
        self.noise, self.reach = noise, reach

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale, ``(*batch, d)`` each."""
        return self.reach * torch.tanh(output / self.reach), torch.full_like(output, self.noise)


def deterministic_network(
    observation_size: int,
    action_size: int,
    *,
    hidden: Sequence[int] = (256, 256),
    noise: float = 0.3,
    reach: float = 3.0,
) -> nn.Module:
    """Return a network from observations to a latent, with a fixed scale of exploration.

    Args:
        observation_size: The number of observed numbers.
        action_size: The number d of action components.
        hidden: Widths of the hidden layers.
        noise: The scale of exploration, in units of the latent.
        reach: The largest absolute value of a latent without noise.
    """
    network = MLP(
        in_features=observation_size,
        out_features=action_size,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
    )
    return nn.Sequential(network, LatentLocation(noise, reach))


def state_value_network(
    observation_size: int, action_size: int, *, hidden: Sequence[int] = (256, 256)
) -> ValueOperator:
    """Return a critic of ``observation`` alone that writes ``state_value``."""
    network = MLP(
        in_features=observation_size,
        out_features=1,
        num_cells=list(hidden),
        activation_class=nn.Tanh,
    )
    return ValueOperator(network, in_keys=["observation"])


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
        observation_size: The number of observed numbers.
        action_size: The number d of action components.
        constraints: The number K of outputs.
        hidden: Widths of the hidden layers.
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
