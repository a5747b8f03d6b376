"""TorchRL's SAC loss without the passes that it can do without."""

from __future__ import annotations

from collections.abc import Callable
from itertools import zip_longest
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeModule, ValueOperator
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import _vmap_func, distance_loss

from cnfp_torchrl.modules import actor_modules
from cnfp_torchrl.objectives.stacked_perceptron import StackedPerceptron

T = TypeVar("T")

_PLAIN_MODULES = (TensorDictModule, SafeModule, ValueOperator)
"""Modules that do no more than call their network on their in_keys and write what it returns."""


class BatchedSACLoss(SACLoss):
    """`torchrl.objectives.SACLoss` with the same arguments, keys, parameters and results, faster.

    The critics are applied together, one batched matrix product a layer, where they are perceptrons
    (`StackedPerceptron`): a `torchrl.modules.MLP`, or a `torch.nn.Sequential`, of linear layers and
    elementwise activations in a TensorDictModule. Other critics go through `torch.vmap` as in
    SACLoss. The actor's own modules are called, once on the states and once on the next ones,
    without swapping their parameters for themselves. A state_dict of either loss is one of the
    other.

    Args:
        args: as for `torchrl.objectives.SACLoss`.
        kwargs: as for `torchrl.objectives.SACLoss`.
    """

    _ensembles: dict[str, StackedPerceptron | Callable[..., TensorDictBase]]

    def _make_vmap(self) -> None:
        # SACLoss calls this when it is made, and when the randomness under vmap is set.
        super()._make_vmap()
        self._ensembles = {}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the actor's loss, and the ``log_prob`` of the actions that it drew."""
        action, log_prob = self._draw(tensordict)
        value = self._values("qvalue_network", tensordict, action, detached=True)
        loss = self._reduce_loss(
            self._alpha * log_prob - value.amin(0).squeeze(-1),
            tensordict=tensordict,
            weights=self._maybe_get_priority_weight(tensordict),
        )
        return loss, {"log_prob": log_prob.detach()}

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss, summed over them, and their largest ``td_error``."""
        target = self._compute_target_v2(tensordict)
        action = tensordict.get(self.tensor_keys.action)
        predicted = self._values("qvalue_network", tensordict, action).squeeze(-1)
        target = target.expand_as(predicted)
        loss = self._reduce_loss(
            distance_loss(predicted, target, loss_function=self.loss_function).sum(0),
            tensordict=tensordict,
            weights=self._maybe_get_priority_weight(tensordict),
        )
        return loss, {"td_error": (predicted.detach() - target).abs().amax(0)}

    @torch.no_grad()
    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        if self.skip_done_states:
            return super()._compute_target_v2(tensordict)
        outcome = tensordict.get("next")
        action, log_prob = self._draw(outcome)
        value = self._values("target_qvalue_network", outcome, action)
        if value.shape[1:] != log_prob.shape:
            log_prob = log_prob.unsqueeze(-1)
        soft = (value - self._alpha * log_prob).amin(0)
        estimator = self.value_estimator
        if getattr(estimator, "average_rewards", False):
            tensordict = tensordict.clone(False)  # whose rewards it replaces
        return estimator.value_estimate(tensordict, next_value=soft).squeeze(-1)

    def _draw(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Draw an action of the actor for each state, with its log-density."""
        actor = self.actor_network
        with set_exploration_type(ExplorationType.RANDOM):
            if self._actor_holds_its_parameters():
                return compute_rsample_log_prob(distribution(actor, tensordict))
            with self.actor_network_params.to_module(actor, preserve_module_state=False):
                return compute_rsample_log_prob(distribution(actor, tensordict))

    def _values(
        self, name: str, tensordict: TensorDictBase, action: Tensor, *, detached: bool = False
    ) -> Tensor:
        """Return what all networks of an ensemble say of actions, ``(n, *batch, out)``.

        Args:
            name: of the ensemble, such as ``qvalue_network``; ``target_`` before it for its target.
            tensordict: the states.
            action: the actions.
            detached: keep gradients from the networks' parameters.
        """
        online = name.removeprefix("target_")
        network = getattr(self, online)
        if online not in self._ensembles:
            self._ensembles[online] = self._ensemble(network)
        apply, action_key = self._ensembles[online], self.tensor_keys.action
        if not isinstance(apply, StackedPerceptron):
            params = getattr(self, f"{name}_params")
            state = tensordict.select(*network.in_keys, strict=False).set(action_key, action)
            state = apply(state, params.detach() if detached else params)
            return state.get(network.out_keys[-1])
        weights = self._weights(f"{name}_params")
        if detached:
            weights = {key: value.detach() for key, value in weights.items()}
        keys = network.in_keys
        inputs = [action if key == action_key else tensordict.get(key) for key in keys]
        return apply(inputs[0] if len(keys) == 1 else torch.cat(inputs, -1), weights)

    def _ensemble(
        self, network: TensorDictModule
    ) -> StackedPerceptron | Callable[..., TensorDictBase]:
        """Return how to apply a network with several sets of parameters."""
        if is_plain(network) and len(network.out_keys) == 1:
            stacked = StackedPerceptron.of(network.module)
            if stacked is not None:
                return stacked
        return _vmap_func(
            network,
            (None, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def _weights(self, name: str) -> dict[str, Tensor]:
        """Return the parameters and buffers of an ensemble by their names in its network."""
        params = getattr(self, name)
        if not isinstance(params, nn.Module):  # the data of the online parameters, made anew
            leaves = params.flatten_keys(".").items()
        else:
            leaves = self._remembered(
                name, lambda: [*params.named_parameters(), *params.named_buffers()]
            )
        return {key.removeprefix("module."): value for key, value in leaves}

    def _actor_holds_its_parameters(self) -> bool:
        """Tell whether the actor's own tensors are those that this loss keeps and trains.

        They are, until this loss is moved, which leaves the actor's buffers where they were.
        """
        own, kept = self.actor_network, self.actor_network_params
        return self._remembered(
            "actor",
            lambda: all(
                first is second or first.data_ptr() == second.data_ptr()
                for first, second in zip_longest(
                    [*own.parameters(), *own.buffers()],
                    [*kept.parameters(), *kept.buffers()],
                    fillvalue=torch.empty(0),
                )
            ),
        )

    def _remembered(self, name: str, make: Callable[[], T]) -> T:
        """Return what was made before, until this loss is moved.

        For what takes long because modules list their parameters slowly. Nothing that a deep copy
        would separate from them, such as their data or detached ones.
        """
        # Where LossModule keeps such things; it empties it when it is moved.
        cache = self.__dict__.setdefault("_cache", {})
        if name not in cache:
            cache[name] = make()
        return cache[name]

    def __getstate__(self) -> dict[str, Any]:
        # What torch.vmap returns cannot be pickled.
        kept = {key: each for key, each in self.__dict__.items() if "_vmap_q" not in key}
        return {**kept, "_ensembles": {}, "_cache": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._make_vmap()


def distribution(
    actor: ProbabilisticTensorDictSequential, tensordict: TensorDictBase
) -> torch.distributions.Distribution:
    """Return ``actor.get_dist(tensordict)`` without the bookkeeping, where the modules are plain.

    tensordict 0.14 looks on disk for pandas at each entry that a TensorDictModule writes, which
    takes longer than a small network.
    """
    *body, head = actor_modules(actor)
    keys = [key for module in body for key in module.out_keys]
    if actor.return_composite or not all(map(is_plain, body)) or not _are_strings(keys):
        return actor.get_dist(tensordict)
    # Entries that are tensordicts are shared, which is safe because only strings are written.
    state = TensorDict(dict(tensordict.items()), tensordict.batch_size, tensordict.device)
    for module in body:
        returned = module.module(*(state.get(key) for key in module.in_keys))
        outputs = returned if isinstance(returned, tuple) else (returned,)
        for key, value in zip(module.out_keys, outputs, strict=True):
            state.set(key, value)
    return head.get_dist(state)


def _are_strings(keys: list[Any]) -> bool:
    return all(isinstance(key, str) and key != "_" for key in keys)


def is_plain(module: nn.Module) -> bool:
    """Tell whether a module only calls its network on its in_keys and writes what that returns."""
    return (
        type(module) in _PLAIN_MODULES
        and module.method is None
        and module._kwargs is None
        and not (module._forward_hooks or module._forward_pre_hooks or module._backward_hooks)
    )
