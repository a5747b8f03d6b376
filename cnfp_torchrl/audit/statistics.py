"""Shares and quantiles of what an audit counts, as plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_Z = 1.959964  # two-sided 95 %
_QUANTILES = {"min": 0.0, "q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
_QUANTILES |= {"max": 1.0}

Quantiles = dict[str, float | None]
"""``min``, ``q05``, ``q25``, ``median``, ``q75``, ``q95``, ``max``."""


@dataclass(frozen=True)
class Share:
    """A share of samples with a 95 % interval.

    Args:
        count: The number of hits.
        of: The number of samples.
        share: ``count / of``; None without samples.
        low: The lower end of the interval.
        high: The upper end of the interval.
    """

    count: int
    of: int
    share: float | None
    low: float
    high: float

    @classmethod
    def clustered(cls, hits: Tensor, totals: Tensor) -> Share:
        """Return a share of samples that come in clusters, the actions tried in one state.

        Wilson's interval, with the sample size that independent samples of the same variance would
        have: actions in one state are alike, so that their number says too much. Where all states
        agree on 0 or 1, the number of states counts.

        Args:
            hits: The number of hits in each cluster, ``(n,)``.
            totals: The number of samples of each cluster, ``(n,)``; empty clusters count for
                nothing.
        """
        hits, totals = hits[totals > 0].double(), totals[totals > 0].double()
        clusters, of = len(totals), int(totals.sum())
        if of == 0:
            return cls(0, 0, None, 0.0, 1.0)
        count = int(hits.sum())
        share = count / of
        if clusters == 1 or count in (0, of):
            return cls(count, of, share, *wilson(share, clusters))
        spread = float((hits - share * totals).square().sum()) * clusters / (clusters - 1)
        size = share * (1 - share) * of**2 / spread if spread > 0 else of
        return cls(count, of, share, *wilson(share, min(size, of)))


def wilson(share: float, size: float) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share that was seen in a sample of some size."""
    weight = _Z**2 / size
    middle = (share + weight / 2) / (1 + weight)
    half = math.sqrt(weight * share * (1 - share) + weight**2 / 4) / (1 + weight)
    # Exactly at the ends, where rounding would leave out the share itself.
    low = 0.0 if share == 0 else max(middle - half, 0.0)
    return low, 1.0 if share == 1 else min(middle + half, 1.0)


def quantiles(values: Tensor) -> Quantiles:
    """Return quantiles of values ``(n,)``; None where there are none or they are infinite."""
    if len(values) == 0:
        return dict.fromkeys(_QUANTILES)
    at = torch.tensor(list(_QUANTILES.values()), dtype=torch.float64, device=values.device)
    # Interpolation between infinities would be NaN.
    found = torch.quantile(values.double(), at, interpolation="nearest").tolist()
    return {
        name: value if math.isfinite(value) else None
        for name, value in zip(_QUANTILES, found, strict=True)
    }


def plain(value: Tensor) -> Any:
    """Return a tensor as nested lists that JSON can hold; infinity and NaN become strings."""
    return _finite(value.tolist())


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(element) for element in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
