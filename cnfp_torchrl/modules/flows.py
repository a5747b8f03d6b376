"""The flows: rules that combine the sets of all constraints into one bijector.

A flow is a small callable, named by `_target_` in ``conf/flow/`` or by its name in `constrain`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from cnfp_torchrl.bijectors import (
    SHARPNESS,
    Bijector,
    BoxSquash,
    ExactSquash,
    GaugeSquash,
    Projection,
    RadialSquash,
    Recession,
    SoftRetraction,
    SoftSquash,
    SquashChain,
    paper_squash,
    require_scale,
    require_sharpness,
)
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, HalfSpaces, Region


class Flow(ABC):
    """A rule that turns the action bounds and the constraints' sets into one bijector."""

    is_safe: ClassVar[bool]
    """Whether every action satisfies all active constraints; then anchor and flags are needed."""

    reads_constraints: ClassVar[bool] = True
    """Whether the constraints' sets are read."""

    takes_actions: ClassVar[bool] = False
    """Whether `of_actions` exists: the flow without a squash before it, for wished actions."""

    moves_with_anchor: ClassVar[bool] = True
    """Whether an anchor moved to an action makes `of_actions` leave that action as it is."""

    has_density: ClassVar[bool] = True
    """Whether actions have a log-density; without one, only the reference entropy exists."""

    @abstractmethod
    def __call__(self, region: Region) -> Bijector:
        """Return the bijector of a region, whose values were checked where they entered.

        Args:
            region: The action bounds and the constraints' sets in order of application. A safe flow
                takes them as relaxed, and its anchor; other flows read the sets alone.
        """

    def of_actions(self, region: Region) -> Bijector:
        """Return the bijector of wished actions, in action units, which it leaves nearly alone.

        Args:
            region: As for a call; its bounds may be infinite.

        Raises:
            TypeError: when the flow squashes all of R^d instead.
        """
        raise TypeError(f"{type(self).__name__}: expected a flow that takes wished actions")

    def needs_anchor(self, sets: Sequence[ConstraintSet]) -> bool:
        """Tell whether `of_actions` needs the anchor of a region of some sets."""
        return True


class RegionFlow(Flow):
    """A bijector onto the intersection of the action bounds and all active sets."""

    is_safe = True

    squash: ClassVar[Callable[..., Bijector]]
    """The class of the bijector, made of a region."""

    def __call__(self, region: Region) -> Bijector:
        return self.squash(region, validate_args=False)


class ExactFlow(RegionFlow):
    """A tanh squash into the action bounds, then retractions into the intersection (default).

    The retractions are a bijective form of alpha projection, and scale along rays by the gauge, as
    RAYEN does (Tordesillas et al. 2023, arXiv 2307.08336): `cnfp_torchrl.bijectors.ExactSquash`.
    """

    squash = ExactSquash


class GaugeFlow(RegionFlow):
    """The exact flow with every retraction radial, of boxes too.

    A set's gauge is its Minkowski functional: `cnfp_torchrl.bijectors.GaugeSquash`.
    """

    squash = GaugeSquash


class SoftFlow(RegionFlow):
    """The exact flow with retractions that leave actions nearly as they are inside the region.

    The retraction of `ExactFlow` shortens a whole ray, although only its end is forbidden; this one
    shortens its end (`cnfp_torchrl.bijectors.SoftSquash`).

    Args:
        sharpness: The sharpness p, from 1 to 100. A larger one moves actions less, and puts more of
            them on the boundary up to rounding.
        by_components: Whether boxes retract each component by itself, not along the ray.
    """

    takes_actions = True

    def __init__(self, sharpness: float = SHARPNESS, by_components: bool = True) -> None:
        self.sharpness = require_sharpness(sharpness)
        self.by_components = by_components

    def __call__(self, region: Region) -> SoftSquash:
        return SoftSquash(
            region,
            sharpness=self.sharpness,
            by_components=self.by_components,
            validate_args=False,
        )

    def of_actions(self, region: Region) -> SoftRetraction:
        return SoftRetraction(
            region,
            sharpness=self.sharpness,
            by_components=self.by_components,
            validate_args=False,
        )


class RecessionFlow(Flow):
    """A move along a common way out of all half-spaces, then a soft retraction into the rest.

    For barriers that all have a braking direction in common, which it leaves alone where they are
    far (`cnfp_torchrl.bijectors.Recession`). Where they have none it is a soft retraction alone.

    Args:
        scale: The scale of its softness: in action units for wished actions, and for a Gaussian
            policy in units of half the bounds' width.
        sharpness: The sharpness of the soft retraction, from 1 to 100.
    """

    is_safe = True
    takes_actions = True
    moves_with_anchor = False

    def __init__(self, scale: float = 1.0, sharpness: float = SHARPNESS) -> None:
        self.scale, self.sharpness = require_scale(scale), require_sharpness(sharpness)

    def __call__(self, region: Region) -> Recession:
        return self._recession(region, of_latents=True)

    def of_actions(self, region: Region) -> Recession:
        return self._recession(region, of_latents=False)

    def needs_anchor(self, sets: Sequence[ConstraintSet]) -> bool:
        bounds, *others = sets
        assert isinstance(bounds, Box)
        unbounded = bool((bounds.low.isinf() & bounds.high.isinf()).all())
        return not (
            unbounded and all(isinstance(constraint_set, HalfSpaces) for constraint_set in others)
        )

    def _recession(self, region: Region, *, of_latents: bool) -> Recession:
        return Recession(
            region,
            scale=self.scale,
            sharpness=self.sharpness,
            of_latents=of_latents,
            validate_args=False,
        )


class RadialFlow(RegionFlow):
    """A radial squash straight onto the intersection; for one or two action dimensions.

    It scales along rays as the ray mask of continuous action masking (Stolz et al. 2024,
    arXiv 2406.03704): `cnfp_torchrl.bijectors.RadialSquash`.
    """

    squash = RadialSquash


class SquashFlow(Flow):
    """The paper's chain of squashes, which guarantees the last constraint only.

    Source: Rietz et al. 2024, arXiv 2405.01198, section Method.

    Args:
        max_radius: The largest radius of balls, in action units. A larger one is replaced by the
            ball of this radius inside it that is nearest to 0, because with the true radius of a
            permissive ball every sample would saturate the tanh of a later box.
    """

    is_safe = False

    def __init__(self, max_radius: float = 2.0) -> None:
        if not max_radius > 0:
            raise ValueError(f"max_radius: expected a number > 0, given {max_radius}")
        self.max_radius = max_radius

    def __call__(self, region: Region) -> Bijector:
        sets = region.sets[1:] or (region.bounds,)
        return SquashChain([paper_squash(self._limited(allowed)) for allowed in sets])

    def _limited(self, allowed: ConstraintSet) -> ConstraintSet:
        return allowed.inner_ball(self.max_radius) if isinstance(allowed, Ball) else allowed


class ProjectionFlow(RegionFlow):
    """A baseline: the action of a tanh-squashed Gaussian, projected onto the intersection.

    As OptLayer (Pham et al., arXiv 1709.07643) and safety layers (Dalal et al. 2018, arXiv
    1801.08757) do. It is no bijection, so that no densities exist
    (`cnfp_torchrl.bijectors.Projection`). It takes all families that come with the library. Onto a
    box with one ball, weighted L1 ball or positive part it is exact, also where a box, a ball or a
    half-space stands alone.

    Args:
        rounds: The number of rounds of Dykstra's algorithm, for other intersections; actions that
            are then still outside are retracted.
    """

    has_density = False

    def __init__(self, rounds: int = 50) -> None:
        if rounds < 1:
            raise ValueError(f"rounds: expected a number >= 1, given {rounds}")
        self.rounds = rounds

    def __call__(self, region: Region) -> Projection:
        return Projection(region, rounds=self.rounds, validate_args=False)


class UnconstrainedFlow(Flow):
    """The tanh squash into the action bounds alone, as in any SAC."""

    is_safe = False
    reads_constraints = False

    def __call__(self, region: Region) -> BoxSquash:
        return BoxSquash(region.bounds.low, region.bounds.high, validate_args=False)


FLOWS: Mapping[str, type[Flow]] = {
    "exact": ExactFlow,
    "gauge": GaugeFlow,
    "soft": SoftFlow,
    "recession": RecessionFlow,
    "radial": RadialFlow,
    "squash": SquashFlow,
    "projection": ProjectionFlow,
    "unconstrained": UnconstrainedFlow,
}


def resolve_safe_flow(flow: Flow | str) -> Flow:
    """Return the flow of a name, or the flow itself, if it guarantees the constraints.

    Raises:
        ValueError: when the name is unknown, or the flow guarantees nothing.
    """
    resolved = resolve_flow(flow)
    if not resolved.is_safe:
        safe = [name for name, flow in FLOWS.items() if flow.is_safe]
        raise ValueError(
            f"flow: expected one that guarantees the constraints, such as {safe}, given "
            f"{type(resolved).__name__}"
        )
    return resolved


def resolve_flow(flow: Flow | str) -> Flow:
    """Return the flow of a name, or the flow itself.

    Raises:
        ValueError: when the name is unknown.
    """
    if isinstance(flow, Flow):
        return flow
    if flow not in FLOWS:
        raise ValueError(f"flow: expected one of {list(FLOWS)} or a Flow, given {flow!r}")
    return FLOWS[flow]()
