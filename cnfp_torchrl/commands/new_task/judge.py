"""The judge: whether a state breaks the limit, the truth that violations are counted by.

It knows the environment's own state, and nothing of the geometry that is to keep the limit: what
both got from the same mistaken formula, no audit could find.
"""

from torch import Tensor

LIMIT = 0.5
"""The highest speed along an axis, in m/s."""


def too_fast(state: Tensor) -> Tensor:
    """Return whether states ``(*batch, 4)`` break the limit, bool ``(*batch,)``."""
    return (state[..., 2:] > LIMIT).any(-1) | (state[..., 2:] < -LIMIT).any(-1)
