"""A check of networks against an environment, before the first step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn
from torch.nn.parameter import is_lazy
from torchrl.envs import EnvBase

_REMEDY = (
    "build it for these sizes; float64 observations, as MuJoCo's, become float32 by "
    "torchrl.envs.DoubleToFloat() in the environment"
)


def require_fit(
    name: str, network: TensorDictModuleBase, env: EnvBase, out_keys: Sequence[NestedKey], size: int
) -> None:
    """Refuse a network that cannot read an environment's states, or writes vectors of other sizes.

    It is tried on two states of zeros, in evaluation mode. Passed over are networks whose sizes are
    open yet (lazy ones), and those that read what the environment does not publish.

    Args:
        name: The network's name, for the message.
        network: The network, with its keys.
        env: The environment.
        out_keys: The keys of the vectors that it writes, which broadcast against each other.
        size: The number of components of these vectors.

    Raises:
        ValueError: naming network, what it reads and writes, and what was expected.
    """
    parameters = list(network.parameters())
    if any(is_lazy(parameter) for parameter in parameters):
        return
    state = env.observation_spec.zero().update(env.full_action_spec.zero())
    if any(state.get(key, None) is None for key in network.in_keys):
        return
    # A batch of two, whatever the environment's, which batch norms and convolutions need.
    state = (
        state.select(*network.in_keys)
        .reshape(-1)[:1]
        .expand(2)
        .to(next((p.device for p in parameters), state.device))
    )
    read = ", ".join(_described(state, key) for key in network.in_keys)
    keys = " and ".join(map(repr, out_keys))
    expected = f"{name}: expected a network that maps {read} to {keys} of {size} components"
    try:
        with torch.no_grad(), _in_evaluation_mode(network):
            written = network(state.copy())
        given = torch.broadcast_shapes(*(written.get(key).shape for key in out_keys))
    except Exception as error:  # networks fail in any way
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{expected}, given one that fails: {reason}; {_REMEDY}") from error
    if given != (*state.batch_size, size):
        shapes = ", ".join(_described(written, key) for key in out_keys)
        raise ValueError(f"{expected}, given one that writes {shapes}; {_REMEDY}")


def _described(tensordict: TensorDictBase, key: NestedKey) -> str:
    """Return an entry's key, dtype and shape in one state."""
    value = tensordict.get(key)
    if isinstance(value, TensorDictBase):
        return repr(key)
    dtype, shape = str(value.dtype).removeprefix("torch."), tuple(value.shape)
    return f"{key!r} ({dtype}, shape {shape[tensordict.ndim :]})"


@contextmanager
def _in_evaluation_mode(network: nn.Module) -> Iterator[None]:
    """Keep a network from learning from what it is tried on, such as by its batch norms."""
    modes = {module: module.training for module in network.modules()}
    try:
        network.eval()
        yield
    finally:
        for module, mode in modes.items():
            module.training = mode
