"""What holds for every example: a user finds it, can ask it for help, and reads it in a minute."""

import ast
import re

import pytest

from tests.examples.scripts import EXAMPLES, run

NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_the_table_lists_every_example_once() -> None:
    rows = re.findall(r"^\| \[`(\w+)\.py`\]\((\w+)\.py\) \| .+ \|$", *readme())
    assert sorted(rows) == [(name, name) for name in NAMES]


def readme() -> tuple[str, re.RegexFlag]:
    return (EXAMPLES / "README.md").read_text(), re.MULTILINE


@pytest.mark.parametrize("name", NAMES)
def test_examples_are_short(name: str) -> None:
    source = (EXAMPLES / f"{name}.py").read_text()
    assert f"python experiments/examples/{name}.py" in (ast.get_docstring(ast.parse(source)) or "")
    assert len(source.splitlines()) <= 160


@pytest.mark.parametrize("name", NAMES)
def test_help_names_the_arguments(name: str) -> None:
    if name.startswith("half_cheetah"):
        pytest.importorskip("mujoco", reason="needs MuJoCo, of the extra 'examples'")
    usage = run(name, "--help")
    assert f"usage: {name}.py" in usage
    assert "--s" in usage
