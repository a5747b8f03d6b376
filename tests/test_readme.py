"""The README's code runs as it stands there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
GIVEN_ACTIONS = (ROOT / "docs" / "given_actions.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_readme_has_code() -> None:
    assert len(BLOCKS) == 4


@pytest.mark.parametrize("block", range(len(BLOCKS)))
def test_code_block_runs(block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(BLOCKS[block], f"README.md block {block}", "exec"), {})


def test_first_block_is_short() -> None:
    lines = [line for line in BLOCKS[0].splitlines() if line.strip()]
    assert len([line for line in lines if not re.match("import |from ", line)]) <= 10


def test_demonstrations_are_cloned_as_the_page_says() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", GIVEN_ACTIONS, flags=re.DOTALL)
    exec(compile(block, "docs/given_actions.md", "exec"), {})


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert links
    missing = [link for link in links if not (Path(__file__).resolve().parents[1] / link).exists()]
    assert not missing
