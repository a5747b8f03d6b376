"""The contract of a bijector: a map from base samples to actions with its log-determinant."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Transform, constraints


class Stages(NamedTuple):
    """The actions that a base sample is mapped to by the first stages of a bijector.

    Args:
        actions: Actions after each stage, ``(stages, *batch, d)``.
        log_dets: Log-determinants of the maps from the base sample to them, ``(stages, *batch)``.
    """

    actions: Tensor
    log_dets: Tensor


class Image(constraints.Constraint):
    """The image of a bijector, as the support of a distribution."""

    event_dim = 1

    def __init__(self, bijector: Bijector) -> None:
        self._bijector = bijector

    def check(self, value: Tensor) -> Tensor:
        """Tell whether each value lies in the image."""
        return self._bijector.contains(value)


class Bijector(Transform):
    """A bijection from R^d onto a set of actions, one set for each batch element.

    Latents and actions have shape ``(*batch, d)``, log-determinants ``(*batch,)``; parameters
    broadcast against the batch. A bijector states `forward_and_log_det`, `inverse_and_log_det` and
    the `shape` of its parameters, and `stages` if it has several. All else that
    `torch.distributions` asks of a transform follows from these. It is not verified that forward
    and inverse agree.
    """

    bijective = True
    domain = constraints.real_vector

    def __init__(self) -> None:
        super().__init__(cache_size=0)

    @abstractmethod
    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action of a latent and log|det d action / d latent|."""

    @abstractmethod
    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latent of an action and log|det d latent / d action|.

        Outside the image and on its boundary a component of the latent is infinite or NaN. So it is
        for a saturated action, which its dtype cannot tell from the boundary: score samples when
        they are drawn instead.
        """

    def contains(self, action: Tensor) -> Tensor:
        """Tell whether each action lies in the image, an open set: its boundary has no latent.

        Decided by the inverse, not by comparisons, which round differently and would accept actions
        whose latent is infinite.
        """
        with torch.no_grad():
            return has_latent(*self.inverse_and_log_det(action))

    @property
    def shape(self) -> torch.Size:
        """The shape ``(*batch, d)`` that latents must broadcast to; empty if any shape will do."""
        return torch.Size()

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and the log-determinant of stage 0 alone, the map into the bounds.

        For the reference entropy (`ReferenceEntropyFlow`). A bijector without retractions is its
        own reference.
        """
        return self.forward_and_log_det(latent)

    def stages(self, latent: Tensor) -> Stages:
        """Return all intermediate actions and their log-determinants in one pass."""
        action, log_det = self.forward_and_log_det(latent)
        return Stages(action.unsqueeze(0), log_det.unsqueeze(0))

    @constraints.dependent_property(is_discrete=False, event_dim=1)
    def codomain(self) -> constraints.Constraint:
        """The image."""
        return Image(self)

    def _call(self, x: Tensor) -> Tensor:
        return self.forward_and_log_det(x)[0]

    def _inverse(self, y: Tensor) -> Tensor:
        return self.inverse_and_log_det(y)[0]

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Return log|det dy/dx| at the latent x; y is not used."""
        return self.forward_and_log_det(x)[1]


def stacked(stages: Iterable[tuple[Tensor, Tensor]]) -> Stages:
    """Return the actions and log-determinants of all stages, broadcast and stacked."""
    actions, log_dets = zip(*stages, strict=True)
    return Stages(
        torch.stack(torch.broadcast_tensors(*actions)),
        torch.stack(torch.broadcast_tensors(*log_dets)),
    )


def has_latent(latent: Tensor, log_det: Tensor) -> Tensor:
    """Tell where an inversion has found a finite latent and log-determinant, ``(*batch,)``."""
    return latent.isfinite().all(-1) & log_det.isfinite()


def log_det_zero(value: Tensor) -> Tensor:
    """Return the log-determinant of the identity at a value, zeros ``(*batch,)``."""
    return torch.zeros_like(value[..., 0])
