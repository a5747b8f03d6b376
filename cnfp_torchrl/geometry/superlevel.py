r"""Descriptions of superlevel sets :math:`\{a : slack(a) \ge t\}`, for the search for anchors.

A convex family states one of them in `ConstraintSet.superlevel`. It need not state derivatives:
Newton's method (`cnfp_torchrl.geometry.anchor`) has those of each kind.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    r"""Linear rows, :math:`n_j \cdot a + \rho_j t \le b_j`.

    Args:
        normals: Normals n, ``(*batch, m, d)``.
        offsets: Offsets b, ``(*batch, m)``; infinite ones are ignored.
        rates: Rates :math:`\rho \ge 0`, ``(*batch, m)``; with :math:`\rho_j = |n_j|` the slack is
            the distance to the row's hyperplane.
    """

    normals: Tensor
    offsets: Tensor
    rates: Tensor


@dataclass(frozen=True, eq=False)
class Cone:
    r"""A second-order cone, :math:`|W a + y| \le h - \rho t`.

    Args:
        matrix: Matrices W, ``(*batch, k, d)``.
        vector: Vectors y, ``(*batch, k)``.
        size: Sizes h at a slack of 0, ``(*batch,)``.
        rate: Rates :math:`\rho > 0`, ``(*batch,)``.
    """

    matrix: Tensor
    vector: Tensor
    size: Tensor
    rate: Tensor


@dataclass(frozen=True, eq=False)
class KinkedSum:
    r"""A sum of kinked terms, :math:`\sum_i \max(\alpha_i a_i, \beta_i a_i) \le h - \rho t`.

    Args:
        upper: Slopes :math:`\alpha`, ``(*batch, d)``.
        lower: Slopes :math:`\beta`, ``(*batch, d)``.
        size: Sizes h at a slack of 0, ``(*batch,)``.
        rate: Rates :math:`\rho \ge 0`, ``(*batch,)``.
    """

    upper: Tensor
    lower: Tensor
    size: Tensor
    rate: Tensor


Superlevel = Rows | Cone | KinkedSum
