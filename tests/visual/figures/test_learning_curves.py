"""Learning curves show what was logged, and say what was not."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from torchrl.record.loggers import CSVLogger

from cnfp_torchrl.visual import constraint_colors
from cnfp_torchrl.visual.figures import learning_curves, read_scalars
from tests.pictures import draws

STEPS = [500, 1000, 1500]
LOGGED = {
    "train/return": [-90.0, -50.0, 3.5],
    "train/steps_per_second": [100.0, 90.0, 80.0],
    "train/alpha": [1.0, 0.8, 0.7],
    "train/entropy": [1.4, 1.2, 1.1],
    "loss/actor": [0.3, 0.1, -0.4],
    "loss/qvalue": [2.0, 1.0, 0.5],
    "violations/obstacle": [4.0, 60.0, 592.0],
    "violations/battery": [0.0, 7.0, 1040.0],
}


@pytest.fixture
def metrics(tmp_path: Path) -> Path:
    logger = CSVLogger("metrics", str(tmp_path))
    for name, values in LOGGED.items():
        for step, value in zip(STEPS, values, strict=True):
            logger.log_scalar(name, value, step=step)
    return tmp_path / "metrics"


def texts(figure: Figure) -> str:
    return " ".join(text.get_text() for text in figure.findobj() if hasattr(text, "get_text"))


def test_scalars_are_read_back(metrics: Path) -> None:
    curves = read_scalars(metrics)
    assert set(curves) == set(LOGGED)
    for name, values in LOGGED.items():
        np.testing.assert_allclose(curves[name], [STEPS, values])


def test_missing_folder_has_no_scalars(tmp_path: Path) -> None:
    assert read_scalars(tmp_path / "metrics") == {}


def test_empty_file_is_no_curve(metrics: Path) -> None:
    (metrics / "scalars" / "empty.csv").write_text("\n")
    assert "empty" not in read_scalars(metrics)


@pytest.mark.parametrize("content", ["1,2,3\n", "step,value\n", "1,2\n3\n"])
def test_broken_file_is_named(metrics: Path, content: str) -> None:
    path = metrics / "scalars" / "broken.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"step,value") as error:
        read_scalars(metrics)
    assert str(path) in str(error.value)


def test_every_curve_is_drawn_as_logged(metrics: Path) -> None:
    figure = learning_curves(read_scalars(metrics), title="a title")
    drawn = [line.get_ydata() for axes in figure.axes for line in axes.lines]
    for name, values in LOGGED.items():
        found = any(np.array_equal(values, line) for line in drawn)
        assert found == (name != "train/steps_per_second"), name
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:2] == ["mean return of an episode", "violations in training (steps)"]
    assert {"critic loss", "actor loss", "policy entropy (nats)"} < set(titles)
    assert len(titles) == len(set(titles))
    assert draws(figure)


def test_violations_have_their_constraints_color_and_total(metrics: Path) -> None:
    axes = learning_curves(read_scalars(metrics)).axes[1]
    colors = constraint_colors(["battery", "obstacle"])
    assert {line.get_label(): line.get_color() for line in axes.lines} == {
        "battery: 1,040": colors["battery"],
        "obstacle: 592": colors["obstacle"],
    }


def test_coinciding_zeros_stay_visible() -> None:
    zero = (np.array([1.0, 2.0]), np.zeros(2))
    axes = learning_curves({"violations/battery": zero, "violations/obstacle": zero}).axes[1]
    first, second = axes.lines
    assert first.get_linewidth() > second.get_linewidth()
    low, high = axes.get_ylim()
    assert low < 0 < 1 <= high


def test_run_without_metrics_says_so() -> None:
    figure = learning_curves({})
    assert "logger=csv" in texts(figure)
    assert draws(figure)


def test_missing_return_and_counts_are_said() -> None:
    figure = learning_curves({"loss/actor": (np.array([5.0]), np.array([1.0]))})
    assert "no episode ended" in texts(figure)
    assert "none counted" in texts(figure)
    assert draws(figure)


def test_single_entry_is_visible() -> None:
    figure = learning_curves({"train/return": (np.array([5.0]), np.array([1.0]))})
    (line,) = figure.axes[0].lines
    assert line.get_marker() == "o"


def test_how_constraints_gave_way_is_one_panel_each_where_they_did() -> None:
    steps = np.array([400.0, 800.0])
    groups = ("relaxed", "dropped", "relaxation", "mean_relaxation")
    names = [f"{group}/{name}" for group in groups for name in ("wall", "power")]
    curves = {name: (steps, np.zeros(2)) for name in names}
    assert len(learning_curves(curves).axes) == 2
    curves["relaxed/wall"] = (steps, np.array([0.0, 0.25]))
    panel = learning_curves(curves).axes[2]
    assert "relaxed" in panel.get_title()
    assert {text.get_text() for text in panel.get_legend().get_texts()} == {
        "wall: 0.25",
        "power: 0",
    }


def test_violations_in_evaluations_are_told_from_those_of_training() -> None:
    steps = np.array([10.0, 20.0])
    evaluated = {"wall": np.zeros(2), "power": np.array([3.0, 1.0])}
    curves = {"violations/wall": (steps, np.array([5.0, 9.0])), "evaluation/score": (steps, steps)}
    curves |= {f"evaluation/violations/{name}": (steps, v) for name, v in evaluated.items()}
    _, training, evaluation, score = learning_curves(curves).axes
    assert "training" in training.get_title()
    for axes in (evaluation, score):
        assert "evaluation" in axes.get_title()
    legend = evaluation.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["wall: 0", "power: 1"]


def test_relaxations_have_the_unit_of_the_action() -> None:
    curves = {"relaxation/wall": (np.array([10.0]), np.array([0.5]))}
    assert "(N m)" in learning_curves(curves, unit="N m").axes[2].get_title()


def test_the_evaluations_stand_beside_the_training() -> None:
    steps, values = np.array([10.0, 20.0]), np.array([1.0, 2.0])
    curves = {"train/return": (steps, values), "evaluation/return": (steps, values + 1)}
    axes = learning_curves(curves).axes[0]
    assert [line.get_label() for line in axes.lines] == ["training", "evaluation"]
    legend = axes.get_legend()
    assert legend is not None
    assert len(legend.get_texts()) == 2
