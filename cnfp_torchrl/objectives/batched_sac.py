"""TorchRL's SAC loss with critics, and states and next states, computed in one batch each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import _vmap_func, distance_loss

from cnfp_torchrl.objectives.actor_pass import distribution, distribution_of_both, is_plain
from cnfp_torchrl.objectives.stacked_perceptron import StackedPerceptron

T = TypeVar("T")

Drawn = tuple[Tensor, Tensor]
"""Actions and their log-densities."""


class BatchedSACLoss(SACLoss):
    """A faster `torchrl.objectives.SACLoss`, with its arguments, keys, parameters and results.

    The critics are applied together, one batched matrix product a layer, where they are perceptrons
    (`StackedPerceptron`): a `torchrl.modules.MLP`, or a `torch.nn.Sequential`, of linear layers and
    elementwise activations in a TensorDictModule. Other critics go through `torch.vmap` as in
    SACLoss. The actor's own modules are called without swapping their parameters for themselves,
    and a constrained actor's flow once for states and next states. A state_dict of either loss is
    one of the other, and a seed gives both the same noise on a CPU.

    Args:
        args: The arguments of `torchrl.objectives.SACLoss`.
        kwargs: The options of `torchrl.objectives.SACLoss`.
    """

    _value_keys: ClassVar[dict[str, str]] = {"qvalue_network": "state_action_value"}
    """The field of `tensor_keys` that names an ensemble's output, by the ensemble's name."""

    _ensembles: dict[str, StackedPerceptron | Callable[..., TensorDictBase]]

    def _make_vmap(self) -> None:
        # Called by SACLoss when it is made, and when the randomness under vmap is set.
        super()._make_vmap()
        self._ensembles = {}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses, ``alpha`` and ``entropy``; write the priority to the tensordict."""
        if self._version == 1 or self.skip_done_states:
            return super().forward(tensordict)
        next_drawn, drawn = self._draw_both(tensordict)
        alpha = self._alpha
        loss_qvalue, metadata = self._critics_loss(tensordict, next_drawn, alpha)
        tensordict.set(self.tensor_keys.priority, metadata["td_error"])
        log_prob = drawn[1].detach()
        losses = {
            "loss_actor": self._actor_loss(tensordict, drawn, alpha),
            "loss_qvalue": loss_qvalue,
            "loss_alpha": self._reduced(self._alpha_loss(log_prob), tensordict),
        }
        scalars = {"alpha": alpha, "entropy": -log_prob.mean()}
        if self.reduction != "none":
            return TensorDict({**losses, **scalars}, [])
        returned = TensorDict(losses, tensordict.batch_size)
        if self.scalar_output_mode == "non_tensor":
            for name, value in scalars.items():
                returned.set_non_tensor(name, value)
        return returned

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the actor's loss, and the ``log_prob`` of the actions that it drew."""
        drawn = self._draw(tensordict)
        return self._actor_loss(tensordict, drawn, self._alpha), {"log_prob": drawn[1].detach()}

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss, summed over them, and their largest ``td_error``."""
        drawn = None
        if not self.skip_done_states:
            with torch.no_grad():
                drawn = self._draw(tensordict.get("next"))
        return self._critics_loss(tensordict, drawn, self._alpha)

    def _actor_loss(self, tensordict: TensorDictBase, drawn: Drawn, alpha: Tensor) -> Tensor:
        action, log_prob = drawn
        value = self._values("qvalue_network", tensordict, action, detached=True)
        return self._reduced(alpha * log_prob - value.amin(0).squeeze(-1), tensordict)

    def _critics_loss(
        self, tensordict: TensorDictBase, drawn: Drawn | None, alpha: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss, for next actions given as drawn or left for TorchRL to draw."""
        if drawn is None:
            target = self._compute_target_v2(tensordict)
        else:
            target = self._target(tensordict, *drawn, alpha)
        action = tensordict.get(self.tensor_keys.action)
        predicted = self._values("qvalue_network", tensordict, action).squeeze(-1)
        target = target.expand_as(predicted)
        loss = distance_loss(predicted, target, loss_function=self.loss_function).sum(0)
        td_error = (predicted.detach() - target).abs().amax(0)
        return self._reduced(loss, tensordict), {"td_error": td_error}

    @torch.no_grad()
    def _target(
        self, tensordict: TensorDictBase, action: Tensor, log_prob: Tensor, alpha: Tensor
    ) -> Tensor:
        value = self._values("target_qvalue_network", tensordict.get("next"), action)
        if value.shape[1:] != log_prob.shape:
            log_prob = log_prob.unsqueeze(-1)
        soft = (value - alpha * log_prob).amin(0)
        estimator = self.value_estimator
        if getattr(estimator, "average_rewards", False):
            tensordict = tensordict.clone(False)  # whose rewards it replaces
        return estimator.value_estimate(tensordict, next_value=soft).squeeze(-1)

    def _reduced(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)

    def _draw(self, tensordict: TensorDictBase) -> Drawn:
        """Draw an action of the actor for each state, with its log-density."""
        with self._acting() as actor:
            return compute_rsample_log_prob(distribution(actor, tensordict))

    def _draw_both(self, tensordict: TensorDictBase) -> tuple[Drawn, Drawn]:
        """Draw actions for the next states, without gradients, and for the states."""
        outcome = tensordict.get("next")
        with self._acting() as actor:
            both = distribution_of_both(actor, outcome, tensordict)
            if both is not None:
                (next_action, action), (next_score, score) = compute_rsample_log_prob(both)
                return (next_action.detach(), next_score.detach()), (action, score)
            with torch.no_grad():
                before = compute_rsample_log_prob(distribution(actor, outcome))
            return before, compute_rsample_log_prob(distribution(actor, tensordict))

    @contextmanager
    def _acting(self) -> Iterator[ProbabilisticTensorDictSequential]:
        """Yield the actor with the parameters that this loss trains."""
        actor = self.actor_network
        with set_exploration_type(ExplorationType.RANDOM):
            if self._actor_holds_its_parameters():
                yield actor
            else:
                with self.actor_network_params.to_module(actor, preserve_module_state=False):
                    yield actor

    def _values(
        self, name: str, tensordict: TensorDictBase, action: Tensor, *, detached: bool = False
    ) -> Tensor:
        """Return the values that all networks of an ensemble give actions, ``(n, *batch, out)``.

        Args:
            name: The ensemble's name, such as ``qvalue_network`` or ``target_qvalue_network``.
            tensordict: The states.
            action: The actions.
            detached: Whether the networks' parameters get no gradient.
        """
        online = name.removeprefix("target_")
        network = getattr(self, online)
        if online not in self._ensembles:
            self._ensembles[online] = self._ensemble(network)
        apply, action_key = self._ensembles[online], self.tensor_keys.action
        value_key = getattr(self.tensor_keys, self._value_keys[online])
        if value_key not in network.out_keys:
            raise KeyError(
                f"{online}: expected it to write {value_key!r}, given one that writes "
                f"{network.out_keys}"
            )
        if not isinstance(apply, StackedPerceptron):
            params = getattr(self, f"{name}_params")
            state = tensordict.select(*network.in_keys, strict=False).set(action_key, action)
            state = apply(state, params.detach() if detached else params)
            return state.get(value_key)
        weights = self._weights(f"{name}_params")
        if detached:
            weights = {key: value.detach() for key, value in weights.items()}
        keys = network.in_keys
        inputs = [action if key == action_key else tensordict.get(key) for key in keys]
        return apply(inputs[0] if len(keys) == 1 else torch.cat(inputs, -1), weights)

    def _ensemble(
        self, network: TensorDictModule
    ) -> StackedPerceptron | Callable[..., TensorDictBase]:
        """Return a function that applies a network with several sets of parameters."""
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
        """Tell whether the actor's own tensors are those that this loss trains.

        They are until this loss is moved, which leaves the actor's buffers on their device.
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
        """Return a value that is made once, and anew after this loss was moved.

        Modules list their parameters slowly, so that what is made of them is kept. It must hold the
        parameters themselves: a deep copy would separate their data, or detached ones, from them.
        """
        # LossModule's own cache, which it empties when it is moved.
        cache = self.__dict__.setdefault("_cache", {})
        if name not in cache:
            cache[name] = make()
        return cache[name]

    def __getstate__(self) -> dict[str, Any]:
        # What torch.vmap returns cannot be pickled.
        kept = {key: value for key, value in self.__dict__.items() if "_vmap_q" not in key}
        return {**kept, "_ensembles": {}, "_cache": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._make_vmap()
