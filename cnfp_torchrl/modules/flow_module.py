"""The probabilistic head of a constrained actor: base distribution and constraint bijectors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, set_interaction_type
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.distributions import Independent, Normal
from torchrl.data import TensorSpec
from torchrl.modules import SafeProbabilisticModule

from cnfp_torchrl.bijectors import Bijector, reach
from cnfp_torchrl.distributions import ConstrainedFlow, ReferenceEntropyFlow
from cnfp_torchrl.geometry import Box, ConstraintSet, Region
from cnfp_torchrl.keys import ACTION_KEY, ANCHOR_KEY, LOC_KEY, SCALE_KEY, require
from cnfp_torchrl.modules.action_bounds import ActionBounds, action_bounds
from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector, in_order
from cnfp_torchrl.modules.flows import Flow, resolve_flow

_ANCHOR_REMEDY = "append cnfp_torchrl.envs.ConstraintAnchor after the geometry transforms"


class LostDensityWarning(UserWarning):
    """Stored actions of an actor have density 0 because rounding has lost their latents."""


class _ActorFlow(ConstrainedFlow):
    """The distribution of an actor, with a callback for its own actions whose latents are lost."""

    on_lost: Callable[[], None] | None = None

    def log_prob(self, value: Tensor) -> Tensor:
        log_prob = super().log_prob(value)
        if self.on_lost is not None and self._has_lost(value, log_prob):
            self.on_lost()
        return log_prob

    def _has_lost(self, value: Tensor, log_prob: Tensor) -> bool:
        if torch.compiler.is_compiling() or is_functorch_wrapped_tensor(log_prob):
            return False
        lost = log_prob.isneginf()
        if not bool(lost.any()):
            return False
        # On the boundary up to rounding; an action further out is not the actor's own.
        _, share = reach(self.bijector, value)
        return bool((lost & (share >= 1 - 64 * torch.finfo(value.dtype).eps)).any())


class _ActorReferenceFlow(_ActorFlow, ReferenceEntropyFlow):
    """An actor's distribution that is scored by the reference entropy."""


class ConstrainedFlowModule(SafeProbabilisticModule):
    """Draw actions from a Gaussian pushed through the bijectors of all constraints.

    Unlike a projection appended to a network (OptLayer, a safety layer, HardNet), the bijectors
    leave the policy a density on the allowed actions; see `cnfp_torchrl.modules.Flow`.

    Reads the Gaussian's parameters and, for each constraint, the geometry that the environment's
    transforms publish; an exact flow also reads the anchor and the active flags that
    `cnfp_torchrl.envs.ConstraintAnchor` computes. Ends an actor, as TorchRL's own probabilistic
    modules do.

    Sets are eroded by the rounding error of the action spec's dtype, in which actions are executed:
    float64 geometry, as from the observations of Gymnasium's MuJoCo environments, is rounded to it
    first, which moves it by less. Actions of a float64 Gaussian are float64, and remain allowed
    when an environment rounds them to a float32 spec.

    Args:
        spec: The bounded action spec of one state, ``(d,)``; its bounds are stage 0 of the flow.
        bijectors: One `ConstraintBijector` for each constraint.
        order: The constraints' names in order of application, the last with the highest priority;
            None takes the bijectors' own order.
        flow: The rule that combines the sets: a `Flow`, or ``exact``, ``gauge``, ``soft``,
            ``recession``, ``radial``, ``squash``, ``projection``, ``unconstrained``.
        in_keys: The keys of the Gaussian's location and scale, each ``(*batch, d)``.
        out_key: The key of the action, ``(*batch, d)``.
        return_log_prob: Whether to write the action's log-density ``(*batch,)``, too.
        default_interaction_type: The interaction type where no exploration type is set.
        kwargs: Further options of `torchrl.modules.SafeProbabilisticModule`, such as
            ``log_prob_key``.

    Raises:
        ValueError: when the spec is unbounded, when an order does not name each constraint once, or
            for the log-density of a flow that has none.
    """

    distribution_type: type[_ActorFlow] = _ActorFlow

    def __init__(
        self,
        spec: TensorSpec,
        bijectors: Sequence[ConstraintBijector],
        *,
        order: Sequence[str] | None = None,
        flow: Flow | str = "exact",
        in_keys: Sequence[NestedKey] = (LOC_KEY, SCALE_KEY),
        out_key: NestedKey = ACTION_KEY,
        return_log_prob: bool = False,
        default_interaction_type: InteractionType = InteractionType.RANDOM,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            in_keys=list(in_keys),
            out_keys=[out_key],
            spec=spec,
            distribution_class=self.distribution_type,
            default_interaction_type=default_interaction_type,
            return_log_prob=return_log_prob,
            **kwargs,
        )
        self._bounds = ActionBounds(action_bounds(spec, out_key))
        self._bijectors = nn.ModuleList(in_order(bijectors, order))
        self.flow = resolve_flow(flow)
        if return_log_prob and not self.flow.has_density:
            raise ValueError(
                f"return_log_prob: expected False for {type(self.flow).__name__}, whose actions "
                "have no density, given True; leave it out, or take another flow"
            )
        self._has_warned = False
        self.parameter_keys = list(in_keys)
        self.in_keys = [*in_keys, *self.geometry_keys()]

    @property
    def bijectors(self) -> list[ConstraintBijector]:
        """The constraints' modules in order of application."""
        return [cast(ConstraintBijector, module) for module in self._bijectors]

    @property
    def order(self) -> list[str]:
        """The constraints' names in order of application."""
        return [bijector.name for bijector in self.bijectors]

    @property
    def bounds(self) -> Box:
        """The action bounds, stage 0, in the dtype of the action spec."""
        return self._bounds.on(None)

    @property
    def action_dim(self) -> int:
        """The number of components of an action."""
        return self._bounds.dim

    @property
    def action_dtype(self) -> torch.dtype:
        """The dtype of the action spec, in which actions are executed."""
        return self._bounds.dtype

    @property
    def action_key(self) -> NestedKey:
        """The key of the action."""
        return self.out_keys[0]

    @property
    def stage_names(self) -> list[str]:
        """The names of the stages of ``get_dist(...).stages``, in order of application."""
        if self.flow.is_safe:
            return ["bounds", *self.order]
        return self.order if self.flow.reads_constraints and self.order else ["bounds"]

    def geometry_keys(self) -> list[NestedKey]:
        """Return the keys, besides the Gaussian's parameters, that the flow reads."""
        if not self.flow.reads_constraints:
            return []
        keys = [key for bijector in self.bijectors for key in bijector.geometry_keys]
        if self.flow.is_safe:
            keys += [bijector.active_key for bijector in self.bijectors]
            keys += [bijector.amounts_key for bijector in self.bijectors] + [ANCHOR_KEY]
        return keys

    def get_bijector(self, tensordict: TensorDictBase) -> Bijector:
        """Return the bijector of the states in a tensordict.

        Raises:
            MissingGeometryError: when geometry, anchor, active flags or relaxations are missing.
        """
        if self.flow.is_safe:
            return self.flow(self._region(tensordict).to(self.action_dtype))
        sets: list[ConstraintSet] = [self._bounds_beside(tensordict)]
        if self.flow.reads_constraints:
            sets += (
                bijector.get_set(tensordict).to(self.action_dtype) for bijector in self.bijectors
            )
        return self.flow(Region(sets, validate_args=False))

    def get_region(self, tensordict: TensorDictBase) -> Region:
        """Return the region of allowed actions, for any flow; needs anchor, flags, relaxations."""
        return self._region(tensordict, validate_args=True)

    def get_dist(self, tensordict: TensorDictBase) -> ConstrainedFlow:
        """Return the distribution over actions in the states of a tensordict."""
        loc, scale = (self.widened(tensordict.get(key)) for key in self.parameter_keys)
        bijector = self.get_bijector(tensordict)
        if self.flow.reads_constraints:
            refuse_other_batch(self.parameter_keys[0], loc, bijector.shape[:-1])
        if loc.shape[-1] != self.action_dim or scale.shape[-1] not in (1, self.action_dim):
            raise ValueError(
                f"keys {self.parameter_keys}: expected a Gaussian of {self.action_dim} components, "
                f"as the action has, given shapes {tuple(loc.shape)} and {tuple(scale.shape)}; "
                "build the network for this action spec"
            )
        base = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
        distribution = self.distribution_type(base, bijector)
        if not self._has_warned:
            distribution.on_lost = self._warn_of_lost_densities
        return distribution

    build_dist_from_params = get_dist

    def widened(self, value: Tensor) -> Tensor:
        """Return a latent, or its parameter, in the action spec's dtype if that is finer."""
        # Not half precision, which is left to be refused.
        return value.to(self.action_dtype) if value.dtype == torch.float32 else value

    def random(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions of standard Gaussian noise, and that Gaussian's location and scale.

        The safe counterpart of TorchRL's method, which draws uniformly from the action spec.
        """
        like = self._bounds_beside(tensordict).low
        zeros = like.new_zeros(*tensordict.shape, self.action_dim)
        for key, value in zip(self.parameter_keys, (zeros, torch.ones_like(zeros)), strict=True):
            tensordict.set(key, value)
        with set_interaction_type(InteractionType.RANDOM):
            return self(tensordict)

    def _warn_of_lost_densities(self) -> None:
        """Warn, once for a module, that ratios of stored actions will be infinite or NaN."""
        self._has_warned = True
        warnings.warn(
            "the density of stored actions is -inf where they are saturated: rounding has moved "
            "them onto the boundary, and with it their latents to infinity. Losses that score "
            "actions of the actor's own, such as PPO, A2C and REINFORCE, need "
            "split_at_latent(actor), whose ratios are exact; for actions of others see "
            "ConstrainedFlow.nearest_log_prob",
            LostDensityWarning,
            stacklevel=2,
        )

    def _bounds_beside(self, tensordict: TensorDictBase) -> Box:
        """Return the bounds on the device of a tensordict's entries."""
        device = tensordict.device
        if device is None:
            found = (tensordict.get(key, None) for key in self.in_keys)
            device = next((value.device for value in found if value is not None), None)
        return self._bounds.on(device)

    def _region(self, tensordict: TensorDictBase, *, validate_args: bool = False) -> Region:
        sets = [self._bounds_beside(tensordict), *(b.get_set(tensordict) for b in self.bijectors)]
        anchor = require(tensordict, ANCHOR_KEY, _ANCHOR_REMEDY)
        return Region(
            sets,
            anchor,
            self._active(tensordict),
            self._relaxation(tensordict, anchor.new_zeros(())),
            validate_args=validate_args,
        )

    def _active(self, tensordict: TensorDictBase) -> Tensor | None:
        if not self.bijectors:
            return None
        flags = [
            require(tensordict, bijector.active_key, _ANCHOR_REMEDY) for bijector in self.bijectors
        ]
        return torch.stack([torch.ones_like(flags[0]), *flags], dim=-1)

    def _relaxation(self, tensordict: TensorDictBase, of_bounds: Tensor) -> tuple[Tensor, ...]:
        """Return the amounts by which the rows of each set are widened, the bounds' first."""
        amounts = [of_bounds]
        for bijector in self.bijectors:
            amount = require(tensordict, bijector.amounts_key, _ANCHOR_REMEDY)
            amounts.append(amount if bijector.row_relaxation_key else amount.unsqueeze(-1))
        return tuple(amounts)


def refuse_other_batch(key: NestedKey, given: Tensor, batch: torch.Size) -> None:
    """Refuse an entry with another batch shape than the sets, which broadcasting may mismatch.

    With n agents that share one set in each of n environments, the set of the i-th environment
    would be used for the i-th agent of all environments.

    Args:
        key: The entry's key.
        given: The entry, ``(*batch, d)``.
        batch: The sets' batch shape.

    Raises:
        ValueError: naming the entry and both shapes.
    """
    if given.shape[:-1] != batch:
        raise ValueError(
            f"key {key!r}: expected the batch shape of the constraints' sets, {tuple(batch)}, "
            f"given a tensor of shape {tuple(given.shape)}; each action needs a set of its own: "
            "put agents into the environment's batch size, or all of their actions into one vector"
        )


class ReferenceEntropyFlowModule(ConstrainedFlowModule):
    """A flow module whose actions are scored by the reference entropy (`ReferenceEntropyFlow`)."""

    distribution_type = _ActorReferenceFlow
