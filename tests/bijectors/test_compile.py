"""`torch.compile(fullgraph=True)` gives the same values and gradients, bijectors built inside."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import (
    Bijector,
    BoxSquash,
    ExactSquash,
    GaugeSquash,
    RadialSquash,
    Retraction,
    SquashChain,
    paper_squash,
)
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Box, ConstraintSet, Region
from tests.bijectors.cases import BY_NAME, Case, cast, latents

FLOWS = [
    "box-d3-batch",
    "ellipsoid-d3-batch",
    "box-ellipsoid-ball-d3-batch",
    "gauge-bounds-d1",
    "gauge-dropped-d3-batch",
    "gauge-all-families-d3-batch",
    "radial-dropped-d3-batch",
    "retraction-ball-d2",
]

Function = Callable[[Tensor, list[dict[str, Tensor]], Tensor], tuple[Tensor, Tensor]]


pytestmark = pytest.mark.usefixtures("fresh_compiler")


def unchecked(case: Case, fields: list[dict[str, Tensor]]) -> tuple[ConstraintSet, ...]:
    return tuple(
        type(constraint_set)(**values, validate_args=False)
        for constraint_set, values in zip(case.sets, fields, strict=True)
    )


def build(case: Case, fields: list[dict[str, Tensor]], anchor: Tensor) -> Bijector:
    """Build a case's bijector from bare tensors, without reading any of them on the host."""
    sets = unchecked(case, fields)
    if case.kind == "squash":
        return paper_squash(sets[0])
    if case.kind == "chain":
        return SquashChain([paper_squash(constraint_set) for constraint_set in sets])
    if case.kind == "retraction":
        outer = sets[0]
        assert isinstance(outer, Box)
        squash = BoxSquash(outer.low, outer.high, validate_args=False)
        return SquashChain([squash, Retraction(outer, sets[1], anchor)])
    region = Region(sets, anchor, case.active)
    if case.kind == "exact":
        return ExactSquash(region, validate_args=False)
    if case.kind == "gauge":
        return GaugeSquash(region, validate_args=False)
    return RadialSquash(region, validate_args=False)


def function(case: Case) -> Function:
    def forward(
        latent: Tensor, fields: list[dict[str, Tensor]], anchor: Tensor
    ) -> tuple[Tensor, Tensor]:
        return build(case, fields, anchor).forward_and_log_det(latent)

    return forward


def arguments(case: Case) -> tuple[list[dict[str, Tensor]], Tensor]:
    fields = [cast(constraint_set, torch.float32).fields() for constraint_set in case.sets]
    return fields, torch.zeros(case.dim) if case.anchor is None else case.anchor.float()


def evaluate(forward: Function, case: Case, latent: Tensor) -> tuple[Tensor, ...]:
    """Return values and the gradients of their sums."""
    latent = latent.clone().requires_grad_()
    action, log_det = forward(latent, *arguments(case))
    (of_action,) = torch.autograd.grad(action.sum(), latent, retain_graph=True)
    (of_log_det,) = torch.autograd.grad(log_det.sum(), latent)
    return action.detach(), log_det.detach(), of_action, of_log_det


def check(case: Case, backend: str, tolerance: float) -> None:
    forward = function(case)
    compiled = torch.compile(forward, fullgraph=True, backend=backend)
    for length in (0.0, 1e-12, 1.0, 20.0, 1e6):
        latent = latents(case, 7, torch.float32, length)
        expected = evaluate(forward, case, latent)
        for value, wanted in zip(evaluate(compiled, case, latent), expected, strict=True):
            torch.testing.assert_close(value, wanted, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", ["box-ellipsoid-ball-d3-batch", "gauge-dropped-d3-batch"])
def test_compiled_bijectors_agree(name: str) -> None:
    check(BY_NAME[name], "aot_eager", 1e-6)


def actor(case: Case) -> Callable[..., tuple[Tensor, Tensor]]:
    def sample(
        loc: Tensor, scale: Tensor, fields: list[dict[str, Tensor]], anchor: Tensor
    ) -> tuple[Tensor, Tensor]:
        base = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
        return ConstrainedFlow(base, build(case, fields, anchor)).rsample_and_log_prob()

    return sample


def test_compiled_distribution_agrees() -> None:
    case = BY_NAME["gauge-dropped-d3-batch"]
    loc, scale = torch.randn(4, 3), torch.full((4, 3), 0.5)
    outputs = []
    for sample in (actor(case), torch.compile(actor(case), fullgraph=True, backend="aot_eager")):
        torch.manual_seed(0)
        outputs.append(sample(loc, scale, *arguments(case)))
    for value, wanted in zip(outputs[1], outputs[0], strict=True):
        torch.testing.assert_close(value, wanted)


@pytest.mark.slow
# Inductor trips over deprecations of PyTorch itself.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("name", FLOWS)
def test_inductor_agrees(name: str) -> None:
    """Inductor fuses and reorders arithmetic: values agree, and actions stay inside the sets."""
    case = BY_NAME[name]
    check(case, "inductor", 1e-4)
    compiled = torch.compile(function(case), fullgraph=True)
    for length in (0.0, 1e-12, 1.0, 20.0, 1e6):
        latent = latents(case, 2000, torch.float32, length)
        action, log_det = compiled(latent, *arguments(case))
        assert log_det.isfinite().all()
        assert case.allows(action).all(), f"at |z| = {length}"
