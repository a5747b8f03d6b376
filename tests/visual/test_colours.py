"""One colour for each constraint."""

import itertools
import re

from cnfp_torchrl.visual.colours import constraint_colours, rgb


def test_colours_do_not_depend_on_the_order() -> None:
    names = ["speed", "battery", "power", "obstacle"]
    expected = constraint_colours(names)
    for order in itertools.permutations(names):
        assert constraint_colours(order) == expected


def test_named_constraints_keep_their_colour_beside_others() -> None:
    alone = constraint_colours(["battery", "obstacle"])
    assert constraint_colours(["a", "b", "obstacle", "battery"]).items() > alone.items()


def test_eight_constraints_look_different() -> None:
    colours = constraint_colours(["battery", "obstacle", *"abcdef"]).values()
    assert len(set(colours)) == 8
    for one, other in itertools.combinations(map(rgb, colours), 2):
        assert sum(abs(x - y) for x, y in zip(one, other, strict=True)) > 60


def test_many_constraints_all_have_a_colour() -> None:
    colours = constraint_colours([f"c{i:02}" for i in range(20)])
    assert len(colours) == 20
    assert all(re.fullmatch("#[0-9A-F]{6}", colour) for colour in colours.values())


def test_rgb() -> None:
    assert rgb("#0072B2") == (0, 0x72, 0xB2)
