"""One color for each constraint."""

import itertools
import re

from cnfp_torchrl.visual.colors import constraint_colors, rgb


def test_colors_do_not_depend_on_the_order() -> None:
    names = ["speed", "battery", "power", "obstacle"]
    expected = constraint_colors(names)
    for order in itertools.permutations(names):
        assert constraint_colors(order) == expected


def test_eight_constraints_look_different() -> None:
    colors = constraint_colors(["battery", "obstacle", *"abcdef"]).values()
    assert len(set(colors)) == 8
    for one, other in itertools.combinations(map(rgb, colors), 2):
        assert sum(abs(x - y) for x, y in zip(one, other, strict=True)) > 60


def test_many_constraints_all_have_a_color() -> None:
    colors = constraint_colors([f"c{i:02}" for i in range(20)])
    assert len(colors) == 20
    assert all(re.fullmatch("#[0-9A-F]{6}", color) for color in colors.values())


def test_rgb() -> None:
    assert rgb("#0072B2") == (0, 0x72, 0xB2)
