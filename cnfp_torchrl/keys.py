"""The keys of the tensordict, and a look-up that explains a missing entry.

The tree of one step, for an environment of `constrain_env` with batch shape ``*batch``, K
constraints and actions of d components::

    observation                          the environment's own, with reward and done under next
    constraints/
        NAME/                            one for each constraint, by its GeometryTransform:
            FIELD    (*batch, *event)        the set's fields, such as center and radius of a Ball
            active   (*batch,) bool          whether the set holds, by ConstraintAnchor
            relaxation      (*batch,)        by how much the set had to be widened, action units
            row_relaxation  (*batch, m)      the same row by row, of sets that have rows
        safe_action  (*batch, d)         a candidate for the anchor, where a geometry knows one
        anchor       (*batch, d)         the point that gauges are taken about, by ConstraintAnchor
    previous_action  (*batch, d)         the action that led to the state, by PreviousAction
    loc, scale       (*batch, d)         the Gaussian's parameters, by the network
    latent           (*batch, d)         what was drawn from it, where `split_at_latent` keeps it
    latent_log_prob  (*batch,)
    action           (*batch, d)         allowed in this state, by the flow
    action_log_prob  (*batch,)           where the actor returns it
    episode_cost     (*batch, K)         violations so far in the episode, by ConstraintCost
    next/                                the state that the action led to, with the same entries,
        cost           (*batch, K)       violations of the action, by the environment's judge
        raw_reward     (*batch, 1)       the reward without the penalty, by RewardPenalty
"""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

CONSTRAINTS_KEY = "constraints"
"""The first part of the keys of geometry, ``("constraints", NAME, FIELD)``."""

ANCHOR_KEY = (CONSTRAINTS_KEY, "anchor")
"""The point strictly inside all active sets that gauges are taken about, ``(*batch, d)``."""

SAFE_ACTION_KEY = (CONSTRAINTS_KEY, "safe_action")
"""A candidate for the anchor: an action that a geometry believes to be safe, ``(*batch, d)``."""

RESERVED_NAMES = (ANCHOR_KEY[-1], SAFE_ACTION_KEY[-1])
"""The entries beside the constraints, after which no constraint may be named."""

CONSTRAINT_STATES = ("active", "relaxed", "dropped")
"""What a constraint is in a state: it holds as stated, by a wider set, or not at all."""

OBSERVATION_KEY = "observation"
ACTION_KEY = "action"
LOC_KEY = "loc"
SCALE_KEY = "scale"
PREVIOUS_ACTION_KEY = "previous_action"
LOG_DET_KEY = "log_det"
LATENT_KEY = "latent"
LATENT_LOG_PROB_KEY = "latent_log_prob"

COST_KEY = "cost"
"""Violations of one step, float32 ``(*batch, K)``; columns named by ``constraint_names``."""

EXECUTED_ACTION_KEY = "executed_action"
"""The allowed action that a free one was mapped to, by `cnfp_torchrl.envs.ConstrainedActions`."""

EPISODE_COST_KEY = "episode_cost"
"""The sum of the costs of an episode so far, float32 ``(*batch, K)``."""

PIXELS_KEY = "pixels"
"""A picture of the state, uint8 ``(*batch, height, width, 3)``, of environments that render."""

REWARD_KEY = "reward"
RAW_REWARD_KEY = "raw_reward"
"""The environment's own reward, kept by `cnfp_torchrl.envs.RewardPenalty`."""


def field_key(constraint: str, field: str) -> tuple[str, str, str]:
    """Return the key of a field of a constraint's set."""
    return (CONSTRAINTS_KEY, constraint, field)


def active_key(constraint: str) -> tuple[str, str, str]:
    """Return the key of the flag that says whether a constraint's set holds in a state."""
    return field_key(constraint, "active")


def relaxation_key(constraint: str) -> tuple[str, str, str]:
    """Return the key of the amount by which a constraint's set was widened, ``(*batch,)``."""
    return field_key(constraint, "relaxation")


def row_relaxation_key(constraint: str) -> tuple[str, str, str]:
    """Return the key of the amounts by which the rows of a set were widened, ``(*batch, m)``."""
    return field_key(constraint, "row_relaxation")


class MissingGeometryError(KeyError):
    """A tensordict lacks an entry that a constraint needs; names the key and what publishes it."""

    def __str__(self) -> str:
        # KeyError shows the repr of its message, with every quote escaped.
        return str(self.args[0])


def require(tensordict: TensorDictBase, key: NestedKey, remedy: str) -> Tensor:
    """Return an entry of a tensordict, or raise an error that says how to get it.

    Args:
        tensordict: The tensordict to read.
        key: The entry's key.
        remedy: An instruction for whoever finds it missing.

    Raises:
        MissingGeometryError: when it is missing.
    """
    value = tensordict.get(key, None)
    if value is None:
        found = sorted(map(str, tensordict.keys(True, True)))
        raise MissingGeometryError(f"expected {key}, found keys {found}; {remedy}")
    return value


def refuse_non_finite(
    name: str, value: Tensor, remedy: str = "", error: type[ValueError] = ValueError
) -> None:
    """Refuse numbers that are not finite, naming the first one.

    Args:
        name: The name of the numbers, for the message.
        value: The numbers, of any shape.
        remedy: An instruction for whoever finds such a number.
        error: The type of the error.

    Raises:
        ValueError: when one is infinite or NaN.
    """
    finite = value.isfinite()
    if not bool(finite.all()):
        index = (~finite).nonzero()[0].tolist()
        raise error(
            f"{name} at index {index}: expected a finite number, given "
            f"{value[tuple(index)].item()}{remedy and f'; {remedy}'}"
        )


def refuse_string(argument: str, given: object) -> None:
    """Refuse a string instead of a sequence of keys or names: it would be split into letters.

    Args:
        argument: The argument's name, for the message.
        given: The value that was passed.

    Raises:
        TypeError: naming the argument and what to write instead.
    """
    if isinstance(given, str):
        raise TypeError(
            f"{argument}: expected a sequence of names, given the string {given!r}; write "
            f"{argument}=[{given!r}]"
        )
