"""What the site's own extensions promise: a page for each name, no foreign resource, formulas."""

import importlib
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from docutils import nodes

import cnfp_torchrl

EXTENSIONS = Path(__file__).resolve().parents[2] / "docs" / "extensions"


@pytest.fixture
def extension(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Return how to import an extension by its name."""
    monkeypatch.syspath_prepend(EXTENSIONS)
    yield importlib.import_module
    for name in [path.stem for path in EXTENSIONS.glob("*.py")]:
        sys.modules.pop(name, None)


def test_every_public_name_has_one_page(extension: type[ModuleType], tmp_path: Path) -> None:
    api, public_names = extension("api"), extension("public_names")
    (tmp_path / "cnfp_torchrl.gone.rst").touch()
    api.write_pages(tmp_path)
    pages = {path.stem for path in tmp_path.glob("*.rst")}
    rooms = public_names.rooms()
    assert {"cnfp_torchrl", "cnfp_torchrl.geometry", "cnfp_torchrl.distributions"} <= rooms.keys()
    homes = {
        public_names.home(room, name)
        for room, module in rooms.items()
        for name in public_names.names_in(module)
    }
    assert pages == {"index", *api.shown_rooms()} | homes
    assert {home.rpartition(".")[0] for home in homes} <= set(api.shown_rooms())
    assert public_names.home("cnfp_torchrl", "Ball") == "cnfp_torchrl.geometry.Ball"
    assert public_names.home("cnfp_torchrl.geometry", "LEEWAY") == "cnfp_torchrl.geometry.LEEWAY"


def test_pages_that_did_not_change_are_left_alone(
    extension: type[ModuleType], tmp_path: Path
) -> None:
    api = extension("api")
    api.write_pages(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    api.write_pages(tmp_path)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


def test_public_names_have_docstrings(extension: type[ModuleType]) -> None:
    undocumented = [
        f"{room}.{name}"
        for room, name, value in extension("public_names").homes()
        if (inspect.isclass(value) or inspect.isroutine(value)) and not inspect.getdoc(value)
    ]
    assert not undocumented


@pytest.mark.parametrize(
    "foreign",
    [
        '<script src="https://elsewhere.org/a.js"></script>',
        '<link rel="stylesheet" href="//elsewhere.org/a.css">',
        '<img alt="" src="http://elsewhere.org/a.png">',
        '<p style="background: url(https://elsewhere.org/a.png)">a</p>',
        '<style>@import "https://elsewhere.org/a.css";</style>',
    ],
)
def test_foreign_resources_are_found(
    extension: type[ModuleType], tmp_path: Path, foreign: str
) -> None:
    own = '<a href="https://elsewhere.org">a</a><script src="a.js"></script>'
    (tmp_path / "own.html").write_text(own)
    (tmp_path / "foreign.html").write_text(own + foreign)
    (found,) = extension("offline").foreign_resources(tmp_path)
    assert found.startswith("foreign.html")
    assert "elsewhere.org/a." in found


def test_foreign_fonts_are_found(extension: type[ModuleType], tmp_path: Path) -> None:
    (tmp_path / "own.css").write_text("@font-face { src: url(own.woff2) }")
    (tmp_path / "a.css").write_text("@font-face { src: url('https://elsewhere.org/a.woff2') }")
    (found,) = extension("offline").foreign_resources(tmp_path)
    assert found.startswith("a.css")


def test_formulas_are_mathml(extension: type[ModuleType]) -> None:
    mathml = extension("mathml")
    shown = mathml._converted(nodes.math(), r"a = \arg\min_{a'} |a' - x|", "inline")
    assert shown.startswith("<math")
    assert "<mo>min</mo>" in shown
    assert "\\" not in shown


def test_names_are_found_as_in_python(extension: type[ModuleType]) -> None:
    names = extension("names")
    assert names._imported("torch.nn.Module") is not None
    assert names._imported("torch.nn.NoSuchModule") is None
    assert names._home_of("cnfp_torchrl.Ball") == "cnfp_torchrl.geometry.Ball"
    assert {"constraint_set", "validate_args"} <= names._identifiers()
    assert "no_such_name" not in names._identifiers()
    assert cnfp_torchrl.__name__ not in names._simple()
