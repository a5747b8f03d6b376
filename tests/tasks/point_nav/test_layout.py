"""Layouts: what they accept, and what they say about what they do not."""

import dataclasses
import math

import pytest
import torch
from omegaconf import OmegaConf

from cnfp_torchrl.tasks.point_nav import Layout, PointNavDynamics


def test_defaults_are_the_reference_task() -> None:
    layout = Layout()
    assert layout.rectangles == ((-0.3, -0.3, 0.3, 0.3),)
    assert layout.stations == ((-0.95, 0.0), (0.95, 0.0), (0.0, -0.95), (0.0, 0.95))
    rest = dataclasses.astuple(layout)[2:]
    assert rest == (1.0, 0.1, 0.1, 0.1, 10.0, 0.95, 0.01, 20, (40, 100))


def test_a_configuration_file_can_state_a_layout() -> None:
    config = OmegaConf.create({"rectangles": [[-0.5, -0.5, 0, 0]], "stations": [[0.5, 0.5]]})
    layout = Layout(**config)
    assert layout == Layout(rectangles=((-0.5, -0.5, 0.0, 0.0),), stations=((0.5, 0.5),))
    assert hash(layout) is not None


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"rectangles": [[0.3, -0.3, -0.3, 0.3]]}, r"rectangles\[0\]: expected .*x_low < x_high"),
        ({"rectangles": [[-0.3, 0.3, 0.3, 0.3]]}, r"rectangles\[0\]: expected .*y_low < y_high"),
        ({"rectangles": [[0, 0, 0.1, 0.1], [0, 0, 1.1, 0.1]]}, r"rectangles\[1\]: .*walls"),
        ({"rectangles": [[0, 0, 0.1]]}, r"rectangles\[0\]: expected 4 numbers, given 3"),
        ({"rectangles": [0, 0, 0.1, 0.1]}, r"rectangles\[0\]: expected a list"),
        ({"rectangles": [[0, 0, math.nan, 0.1]]}, r"rectangles\[0\]: expected a finite number"),
        ({"rectangles": None}, "rectangles: expected a list"),
        ({"stations": []}, "stations: expected at least one"),
        ({"stations": [[0, 0]]}, r"stations\[0\]: .*outside all rectangles"),
        ({"stations": [[0.5, 1.0]]}, r"stations\[0\]: .*within the walls"),
        ({"stations": [[0.5, "north"]]}, r"stations\[0\]: expected a finite number"),
        ({"wall": 0.0}, "wall: expected a finite number > 0"),
        ({"zone_radius": -0.1}, "zone_radius: expected a finite number > 0"),
        ({"step_length": math.inf}, "step_length: expected a finite number > 0"),
        ({"goal_radius": True}, "goal_radius: expected a finite number > 0"),
        ({"goal_bonus": math.nan}, "goal_bonus: expected a finite number"),
        ({"start_limit": 1.1}, "start_limit: expected at most the wall"),
        ({"start_margin": -0.01}, "start_margin: expected a finite number >= 0"),
        ({"battery_threshold": 100}, "battery_threshold: expected a percentage"),
        ({"battery_threshold": 20.5}, "battery_threshold: expected whole"),
        ({"battery_start": (20, 100)}, "battery_start: expected .*threshold = 20 < lowest"),
        ({"battery_start": (60, 50)}, "battery_start: expected"),
        ({"battery_start": (40, 101)}, "battery_start: expected"),
        ({"battery_start": 40}, "battery_start: expected a list"),
    ],
)
def test_errors_name_the_field(bad: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=r"Layout\." + message):
        Layout(**bad)  # type: ignore[arg-type]


def test_rectangles_must_leave_room_for_starts() -> None:
    with pytest.raises(ValueError, match="room for starts"):
        PointNavDynamics(Layout(rectangles=((-0.97, -0.97, 0.97, 0.97),), stations=((0.98, 0.98),)))


@pytest.mark.parametrize(
    "rectangles", [(), ((-0.3, -0.3, 0.3, 0.3),), ((-1, -1, 0, 0), (0, 0, 1, 1))]
)
def test_starts_are_uniform_over_the_free_region(rectangles: tuple) -> None:
    layout = Layout(rectangles=rectangles, stations=((-0.5, 0.5),))
    draw = PointNavDynamics(layout).sample_positions(
        torch.Size([40_000]), torch.Generator().manual_seed(1)
    )
    assert draw.abs().max() <= 0.95
    free = torch.rand(40_000, 2, dtype=torch.float64) * 1.9 - 0.95
    for x_low, y_low, x_high, y_high in rectangles:
        low = torch.tensor([x_low, y_low]) - 0.01
        high = torch.tensor([x_high, y_high]) + 0.01
        assert not ((draw > low + 1e-6) & (draw < high - 1e-6)).all(-1).any()
        free = free[~((free > low) & (free < high)).all(-1)]
    # Against rejection: shares of a 4 x 4 grid, with a standard error of at most 0.0025.
    cells = [torch.bucketize(x.float(), torch.tensor([-0.5, 0.0, 0.5])) for x in (draw, free)]
    shares = [
        torch.bincount(4 * cell[:, 0] + cell[:, 1], minlength=16) / len(cell) for cell in cells
    ]
    assert (shares[0] - shares[1]).abs().max() < 0.012


def test_starting_charges_are_whole_and_cover_both_ends() -> None:
    dynamics = PointNavDynamics(Layout(battery_start=(40, 43)))
    battery = dynamics.sample(torch.Size([200]), torch.Generator().manual_seed(0)).battery
    assert battery.dtype == torch.int64
    assert sorted(set(battery.tolist())) == [40, 41, 42, 43]
