"""Distributions over allowed actions: a base distribution pushed through a bijector."""

from __future__ import annotations

import math
from typing import TypeAlias

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution
from torch.distributions.utils import _standard_normal

from cnfp_torchrl.bijectors import Bijector, Stages, has_latent
from cnfp_torchrl.geometry import broadcast_shape

Shape: TypeAlias = torch.Size | list[int] | tuple[int, ...]


class ConstrainedFlow(TransformedDistribution):
    r"""The distribution of :math:`a = f(z)`, z from the base and f a bijector onto allowed actions.

    :math:`\log \pi(a) = \log p(z) - \log|\det \partial f/\partial z|` (paper, eq.
    change_of_variables). Every sample, mode and deterministic action lies in the image of the
    bijector, whatever the base.

    Draw and score together with `rsample_and_log_prob`: `log_prob` of a given action inverts the
    bijector, and where tanh is saturated in the dtype the inverse is lost.

    Args:
        base: over R^d with ``event_shape (d,)``, of float32 or float64; expanded to the batch shape
            of the bijector where that is larger, so that each set has samples of its own.
        bijector: from R^d onto the allowed actions.

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
        # What TransformedDistribution.__init__ would find out about any list of transforms.
        self.bijector = bijector
        self.base_dist = _expanded(base, bijector)
        self.transforms = [bijector]
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
        return _in_dtype_of(latent, action), latent_log_prob - log_det

    def sample_and_log_prob(self, sample_shape: Shape = ()) -> tuple[Tensor, Tensor]:
        """Return actions ``(*sample, *batch, d)`` without gradients and their log-densities.

        The log-densities keep the gradient of the score function, as TorchRL's distributions do.
        """
        latent = _checked(self.base_dist.sample(torch.Size(sample_shape)))
        with torch.no_grad():
            action, log_det = self._forward_and_scored_log_det(latent)
        return _in_dtype_of(latent, action), _log_prob(self.base_dist, latent) - log_det

    def rsample(self, sample_shape: Shape = ()) -> Tensor:
        """Return reparametrized actions ``(*sample, *batch, d)``."""
        return self._pushed(self.base_dist.rsample(torch.Size(sample_shape)))

    def sample(self, sample_shape: Shape = ()) -> Tensor:
        """Return actions ``(*sample, *batch, d)`` without gradients."""
        with torch.no_grad():
            return self._pushed(self.base_dist.sample(torch.Size(sample_shape)))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of actions by inversion, -inf outside the support.

        A NaN action has a NaN density. On the boundary, where saturated actions of float32 may lie,
        the density's limit is taken: -inf.
        """
        inside, undefined = self.bijector.contains(value), value.isnan().any(-1)
        # Replaced before the inversion, because NaN would reach the gradients through `torch.where`
        # after it; by the action of a unit latent, because at 0 some bijectors are not smooth.
        interior = self.bijector(torch.full_like(value, value.shape[-1] ** -0.5))
        inside_value = torch.where(inside.unsqueeze(-1), value, interior)
        latent, log_det = self.bijector.inverse_and_log_det(inside_value)
        # What is scored decides. It may round otherwise than the same inversion did in `contains`,
        # where an action that is broadcast to a batch of sets had another memory layout.
        inside = inside & has_latent(latent, log_det)
        latent = torch.where(inside.unsqueeze(-1), latent, 0)
        elsewhere = torch.where(undefined, torch.nan, -torch.inf).to(log_det)
        return torch.where(inside, _log_prob(self.base_dist, latent) + log_det, elsewhere)

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

    def _pushed(self, latent: Tensor) -> Tensor:
        return _in_dtype_of(latent, self.bijector(_checked(latent)))

    def _forward_and_scored_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        return self.bijector.forward_and_log_det(latent)


class ReferenceEntropyFlow(ConstrainedFlow):
    r"""The same samples, scored jointly by their density in the coordinates of stage 0.

    `rsample_and_log_prob` and `sample_and_log_prob` leave the retractions' :math:`d \log s` out, so
    that the negative mean is the entropy of the tanh-squashed base in the action bounds, for which
    the usual target entropy -d is right and whose gradient is bounded (`docs/method.md`, section 2,
    Entropy). For losses only; `log_prob` remains the true density.
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
    """Draw from a base and score the draw.

    A Gaussian's noise is scored where it is drawn: recovering it as (z - loc) / scale would lose it
    to rounding where the scale is small beside the location, and costs more.
    """
    gaussian = _gaussian(base)
    if gaussian is None:
        latent = base.rsample(shape)
        return latent, base.log_prob(latent)
    loc, scale = gaussian.loc, gaussian.scale
    noise = _standard_normal((*shape, *loc.shape), dtype=loc.dtype, device=loc.device)
    surprise = torch.addcmul(scale.log(), noise, noise, value=0.5).sum(-1)
    constant = -0.5 * math.log(2 * math.pi) * loc.shape[-1]
    return torch.addcmul(loc, scale, noise), constant - surprise


def _log_prob(base: Distribution, latent: Tensor) -> Tensor:
    # `Independent` cannot score an empty batch.
    gaussian = _gaussian(base)
    return base.log_prob(latent) if gaussian is None else gaussian.log_prob(latent).sum(-1)


def _gaussian(base: Distribution) -> Normal | None:
    """Return the independent Gaussians that a base is made of, None if it is something else."""
    gaussian = base.base_dist if isinstance(base, Independent) else None
    if type(gaussian) is not Normal or len(gaussian.batch_shape) != len(base.batch_shape) + 1:
        return None
    return gaussian
