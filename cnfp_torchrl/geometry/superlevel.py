r"""Descriptions of superlevel sets :math:`\{a : slack(a) \ge t\}`, by which anchors are found.

A convex family states one of them in `ConstraintSet.superlevel`. Newton's method
(`cnfp_torchrl.geometry.anchor`) knows the derivatives of each kind, so a family needs none of its
own.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    r"""Linear rows, :math:`n_j \cdot a + \rho_j t \le b_j`.

    Args:
        normals: n, ``(*batch, m, d)``.
        offsets: b, ``(*batch, m)``; infinite ones are ignored.
        rates: :math:`\rho \ge 0`, ``(*batch, m)``; :math:`\rho_j = |n_j|` measures slack by the
            distance to the row's hyperplane.
    """

    normals: Tensor
    offsets: Tensor
    rates: Tensor


@dataclass(frozen=True, eq=False)
class Cone:
    r"""A second-order cone, :math:`|W a + y| \le h - \rho t`.

    Args:
        matrix: W, ``(*batch, k, d)``.
        vector: y, ``(*batch, k)``.
        size: h, ``(*batch,)``.
        rate: :math:`\rho > 0`, ``(*batch,)``.
    """

    matrix: Tensor
    vector: Tensor
    size: Tensor
    rate: Tensor


@dataclass(frozen=True, eq=False)
class KinkedSum:
    r"""A sum of kinked terms, :math:`\sum_i \max(\alpha_i a_i, \beta_i a_i) \le h - \rho t`.

    Args:
        upper: :math:`\alpha`, ``(*batch, d)``.
        lower: :math:`\beta`, ``(*batch, d)``.
        size: h, ``(*batch,)``.
        rate: :math:`\rho \ge 0`, ``(*batch,)``.
    """

    upper: Tensor
    lower: Tensor
    size: Tensor
    rate: Tensor


Superlevel = Rows | Cone | KinkedSum
