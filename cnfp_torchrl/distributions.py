"""Distributions over allowed actions: a base distribution pushed through a bijector."""

from __future__ import annotations

import math
from typing import NamedTuple, NoReturn, TypeAlias

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution
from torch.distributions.utils import _standard_normal

from cnfp_torchrl.bijectors import Bijector, Stages, has_latent, well_inside
from cnfp_torchrl.geometry import broadcast_shape, component_sum
from cnfp_torchrl.keys import refuse_non_finite

Shape: TypeAlias = torch.Size | list[int] | tuple[int, ...]


class NearestLogProb(NamedTuple):
    """Densities of the actions well inside that are nearest to given ones.

    Args:
        log_prob: Log-densities of the nearest actions, ``(*batch,)``.
        action: Nearest actions, ``(*batch, d)``.
        moved: Distances to the given actions, ``(*batch,)``, in action units; 0 for those that were
            well inside.
    """

    log_prob: Tensor
    action: Tensor
    moved: Tensor


class ConstrainedFlow(TransformedDistribution):
    r"""The distribution of :math:`a = f(z)`, z from a base and f a bijector onto allowed actions.

    :math:`\log \pi(a) = \log p(z) - \log|\det \partial f/\partial z|` (paper, eq.
    change_of_variables). Every sample, mode and deterministic action lies in the image of the
    bijector, whatever the base.

    Where tanh is saturated in the dtype, an action determines its latent no more, and its density
    is -inf. The latent of the last draw is kept, so that `log_prob` of that very tensor, unless it
    was changed since, is the density of the draw, as from `rsample_and_log_prob`.

    Args:
        base: The distribution over R^d with ``event_shape (d,)``, of float32 or float64; expanded
            to the batch shape of the bijector where that is larger, so that each set has samples of
            its own.
        bijector: The bijector from R^d onto the allowed actions.

    Raises:
        ValueError: when the base is not a distribution over vectors of the bijector's dimension,
            or, on sampling, is one of half precision or of a coarser dtype than the bijector.
    """

    def __init__(self, base: Distribution, bijector: Bijector) -> None:
        if len(base.event_shape) != 1:
            raise ValueError(
                "base: expected a distribution over vectors (event_shape (d,)), given "
                f"{type(base).__name__} with event_shape {tuple(base.event_shape)}; wrap it in "
                "torch.distributions.Independent(base, 1)"
            )
        # Set here, not by TransformedDistribution.__init__, which works them out at every call.
        self.bijector = bijector
        self.base_dist = _expanded(base, bijector)
        self.transforms = [bijector]
        self._last: _Draw | None = None
        Distribution.__init__(
            self, self.base_dist.batch_shape, self.base_dist.event_shape, validate_args=False
        )

    def expand(
        self, batch_shape: Shape, _instance: ConstrainedFlow | None = None
    ) -> ConstrainedFlow:
        """Return the same distribution with a larger batch shape."""
        return type(self)(self.base_dist.expand(torch.Size(batch_shape)), self.bijector)

    def rsample_and_log_prob(self, sample_shape: Shape = ()) -> tuple[Tensor, Tensor]:
        """Return reparametrized actions ``(*sample, *batch, d)`` and their log-densities."""
        latent, latent_log_prob = _rsample_and_log_prob(self.base_dist, torch.Size(sample_shape))
        action, log_det = self._forward_and_scored_log_det(_checked(latent))
        return self._kept(latent, action), latent_log_prob - log_det

    def sample_and_log_prob(self, sample_shape: Shape = ()) -> tuple[Tensor, Tensor]:
        """Return actions ``(*sample, *batch, d)`` without gradients and their log-densities.

        The log-densities keep the gradient of the score function, as TorchRL's distributions do.
        """
        latent = _checked(self.base_dist.sample(torch.Size(sample_shape)))
        with torch.no_grad():
            action, log_det = self._forward_and_scored_log_det(latent)
        return self._kept(latent, action), _log_prob(self.base_dist, latent) - log_det

    def rsample(self, sample_shape: Shape = ()) -> Tensor:
        """Return reparametrized actions ``(*sample, *batch, d)``."""
        return self._pushed(self.base_dist.rsample(torch.Size(sample_shape)))

    def sample(self, sample_shape: Shape = ()) -> Tensor:
        """Return actions ``(*sample, *batch, d)`` without gradients."""
        with torch.no_grad():
            return self._pushed(self.base_dist.sample(torch.Size(sample_shape)))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of actions ``(*sample, *batch, d)``, -inf outside the support.

        Computed by inversion, or, for the tensor that was drawn last, from its latent, with the
        gradient of the draw. A NaN action has a NaN density. On the boundary, where saturated
        actions of float32 may lie, the density's limit is taken: -inf.

        Raises:
            ValueError: when the value is not floating, not of vectors of d components, or of a
                batch that does not broadcast with the distribution's.
        """
        self._refuse_other_shapes(value)
        if self._last is not None and self._last.is_of(value):
            latent = self._last.latent
            log_det = self.bijector.forward_and_log_det(latent)[1]
            return _log_prob(self.base_dist, latent) - log_det
        inside, undefined = self.bijector.contains(value), value.isnan().any(-1)
        # Replaced before the inversion, because NaN would reach the gradients through `torch.where`
        # after it; by the action of a unit latent, because at 0 some bijectors are not smooth.
        interior = self.bijector(torch.full_like(value, value.shape[-1] ** -0.5))
        inside_value = torch.where(inside.unsqueeze(-1), value, interior)
        latent, log_det = self.bijector.inverse_and_log_det(inside_value)
        # The inversion that is scored decides, not only that of `contains`, which may round
        # otherwise: there an action broadcast to a batch of sets had another memory layout.
        inside = inside & has_latent(latent, log_det)
        latent = torch.where(inside.unsqueeze(-1), latent, 0)
        elsewhere = torch.where(undefined, torch.nan, -torch.inf).to(log_det)
        return torch.where(inside, _log_prob(self.base_dist, latent) + log_det, elsewhere)

    def entropy(self) -> NoReturn:
        """Refuse to give an entropy, which has no closed form.

        Raises:
            NotImplementedError: always; TorchRL's losses then average samples of their own.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no entropy in closed form; estimate it by "
            "-distribution.rsample_and_log_prob((n,))[1].mean(0)"
        )

    def stages(self, latent: Tensor) -> Stages:
        """Return intermediate actions and log-determinants of latents ``(*sample, *batch, d)``."""
        return self.bijector.stages(latent)

    @property
    def deterministic_sample(self) -> Tensor:
        """The base mean pushed through the flow, ``(*batch, d)``: the action without noise."""
        return self._pushed(self.base_dist.mean)

    @property
    def mode(self) -> Tensor:
        """The deterministic action, as the density's own mode has no closed form."""
        return self.deterministic_sample

    @property
    def mean(self) -> Tensor:
        """The deterministic action, as the true mean has no closed form and may break a constraint.

        TorchRL asks for it under `ExplorationType.MEAN`; without it, it would take the mean of 1000
        samples, which can lie outside a non-convex set.
        """
        return self.deterministic_sample

    def nearest_log_prob(self, value: Tensor, depth: float = 1e-3) -> NearestLogProb:
        """Return the density of the action well inside that is nearest to each given one.

        For actions that did not come from a flow, such as demonstrations or offline data. They may
        lie on the boundary or slightly outside, where `log_prob` is -inf and behavior cloning
        learns nothing. Nearest means along the ray from the anchor, as in alpha projection. An
        action well inside stays as it is, with its own density. ::

            scored = actor.get_dist(batch).nearest_log_prob(batch["action"])
            loss = -scored.log_prob.mean()

        Args:
            value: Actions ``(*sample, *batch, d)``, finite.
            depth: The share of the ray from the anchor to the boundary that is left ahead of an
                action, between 0 and 1; at least about the square root of the dtype's rounding
                error, for the density to be exact.

        Raises:
            ValueError: for a depth outside of (0, 1), and for actions of another shape or dtype or
                not finite.
        """
        if not 0 < depth < 1:
            raise ValueError(f"depth: expected a share between 0 and 1, given {depth}")
        self._refuse_other_shapes(value)
        refuse_non_finite("value", value)
        action = well_inside(self.bijector, value, depth)
        moved = torch.linalg.vector_norm(value - action, dim=-1)
        return NearestLogProb(self.log_prob(action), action, moved)

    def _pushed(self, latent: Tensor) -> Tensor:
        return self._kept(latent, self.bijector(_checked(latent)))

    def _kept(self, latent: Tensor, action: Tensor) -> Tensor:
        self._last = _Draw(latent, _in_dtype_of(latent, action))
        return action

    def _refuse_other_shapes(self, value: Tensor) -> None:
        dim = self.event_shape[0]
        if value.is_floating_point() and value.ndim > 0 and value.shape[-1] == dim:
            try:
                torch.broadcast_shapes(value.shape[:-1], self.batch_shape)
            except RuntimeError:
                pass
            else:
                return
        raise ValueError(
            f"value: expected floating actions (*sample, *batch, d) with batch shape "
            f"{tuple(self.batch_shape)} and d = {dim}, given shape {tuple(value.shape)} and "
            f"{value.dtype}"
        )

    def _forward_and_scored_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        return self.bijector.forward_and_log_det(latent)


class _Draw:
    """A drawn action with its latent."""

    def __init__(self, latent: Tensor, action: Tensor) -> None:
        self.latent = latent
        self._action = action
        self._state = _state(action)

    def is_of(self, value: Tensor) -> bool:
        """Tell whether a value is the drawn tensor, unchanged since."""
        # By identity, not by equality: saturated actions of different latents are equal. A tensor
        # that gradients were asked for since is another one: its density must depend on it.
        return value is self._action and _state(value) == self._state


def _state(action: Tensor) -> tuple[int, bool]:
    """Return what changes when an action is changed in place, and whether it needs gradients."""
    # 0 instead of the version in inference mode, which keeps none, and in compiled code, which
    # cannot read it: there an action must not be changed in place before it is scored.
    if torch.compiler.is_compiling() or action.is_inference():
        return 0, action.requires_grad
    return action._version, action.requires_grad


class ReferenceEntropyFlow(ConstrainedFlow):
    r"""A constrained flow whose draws are scored by their density before the retractions.

    `rsample_and_log_prob` and `sample_and_log_prob` leave out the log-determinant of the
    retractions. Their negative mean is the entropy of the tanh-squashed base in the action bounds,
    for which the usual target entropy -d is right and whose gradient is bounded (`docs/method.md`,
    section 2, Entropy). For losses only: `log_prob` remains the true density.
    """

    def _forward_and_scored_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        return self.bijector.forward_and_reference_log_det(latent)


def _expanded(base: Distribution, bijector: Bijector) -> Distribution:
    *batch, dim = bijector.shape or base.event_shape
    if dim != base.event_shape[0]:
        raise ValueError(
            f"base: expected event_shape ({dim},), the bijector's action dimension, given "
            f"{tuple(base.event_shape)}"
        )
    shape = torch.Size(batch)
    if len(shape) == 0 or shape == base.batch_shape:
        return base
    return base.expand(broadcast_shape(shape, base.batch_shape))


def _checked(latent: Tensor) -> Tensor:
    if latent.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"base: expected samples of float32 or float64, given {latent.dtype}; convert its "
            "parameters (half precision cannot hold a boundary with zero tolerance)"
        )
    return latent


def _in_dtype_of(latent: Tensor, action: Tensor) -> Tensor:
    if action.dtype != latent.dtype:
        raise ValueError(
            f"base: expected samples of {action.dtype}, as the bijector's sets are, given "
            f"{latent.dtype}, whose rounding errors exceed the margin that the sets leave; "
            "convert the base's parameters or the sets"
        )
    return action


def _rsample_and_log_prob(base: Distribution, shape: torch.Size) -> tuple[Tensor, Tensor]:
    """Return a draw from a base and its log-density.

    A Gaussian is scored by its noise as drawn, not by ``(z - loc) / scale``, which loses the noise
    to rounding where the scale is small beside the location, and costs more.
    """
    gaussian = _gaussian(base)
    if gaussian is None:
        latent = base.rsample(shape)
        return latent, base.log_prob(latent)
    loc, scale = gaussian.loc, gaussian.scale
    noise = _standard_normal((*shape, *loc.shape), dtype=loc.dtype, device=loc.device)
    surprise = component_sum(torch.addcmul(scale.log(), noise, noise, value=0.5))
    constant = -0.5 * math.log(2 * math.pi) * loc.shape[-1]
    return torch.addcmul(loc, scale, noise), constant - surprise


def _log_prob(base: Distribution, latent: Tensor) -> Tensor:
    # Not by `Independent`, which cannot score an empty batch.
    gaussian = _gaussian(base)
    return base.log_prob(latent) if gaussian is None else gaussian.log_prob(latent).sum(-1)


def _gaussian(base: Distribution) -> Normal | None:
    """Return the Gaussians that a base of independent ones is made of, None for other bases."""
    gaussian = base.base_dist if isinstance(base, Independent) else None
    if type(gaussian) is not Normal or len(gaussian.batch_shape) != len(base.batch_shape) + 1:
        return None
    return gaussian
