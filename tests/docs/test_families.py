"""The code of docs/families.md runs as it stands there, one block after the other."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from cnfp_torchrl.envs import GeometryTransform, constrain_env
from cnfp_torchrl.geometry import HalfSpaces
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.testing import FamilyError, check_constraint_set

GUIDE = (Path(__file__).resolve().parents[2] / "docs" / "families.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", GUIDE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def guide() -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "families"}
    assert len(BLOCKS) == 3
    for number, block in enumerate(BLOCKS):
        name = f"docs/families.md block {number}"
        exec(compile(block, name, "exec", dont_inherit=True), names)
    return names


def oriented_boxes(family: Any, d: int) -> Any:
    rotation = torch.linalg.qr(torch.randn(5, d, d)).Q
    return family(rotation, 0.3 * torch.randn(5, d), 0.1 + torch.rand(5, d))


@pytest.mark.parametrize("d", [1, 2, 6, 12])
def test_the_family_is_right_in_any_dimension(guide: dict[str, Any], d: int) -> None:
    sets = oriented_boxes(guide["OrientedBox"], d)
    check_constraint_set(sets, sets.center + 0.2 * sets.half / d)


def test_it_is_the_intersection_of_half_spaces(guide: dict[str, Any]) -> None:
    sets = oriented_boxes(guide["OrientedBox"], 3)
    rows = sets.superlevel()
    half_spaces = HalfSpaces(rows.normals, rows.offsets)
    way = torch.randn(100, 5, 3)
    torch.testing.assert_close(sets.slack(way), half_spaces.slack(way))
    gauges = [family.gauge(way, sets.center) for family in (sets, half_spaces)]
    torch.testing.assert_close(*gauges, rtol=1e-4, atol=1e-4)


def test_rotations_are_checked(guide: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="'rotation' at index"):
        guide["OrientedBox"](2 * torch.eye(2), torch.zeros(2), torch.ones(2))


def test_a_flawed_one_is_caught(guide: dict[str, Any]) -> None:
    """The message shown in the guide is the one that comes."""
    flawed = type("OrientedBox", (guide["OrientedBox"],), {"eroded": lambda self, _=1.0: self})
    sets = oriented_boxes(flawed, 3)
    with pytest.raises(FamilyError, match=r"OrientedBox\.eroded: expected room for rounding error"):
        check_constraint_set(sets, sets.center + 0.05)


def test_it_holds_in_an_environment(guide: dict[str, Any]) -> None:
    assert issubclass(guide["BodyLimits"], GeometryTransform)
    env = constrain_env(PointNavEnv([64]), guide["BodyLimits"]("limits"))
    assert env.rollout(5)["constraints", "limits", "active"].all()
