"""The README's code runs as it stands there."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_readme_has_code() -> None:
    assert len(BLOCKS) == 4


@pytest.mark.parametrize("block", range(len(BLOCKS)))
def test_code_block_runs(block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(BLOCKS[block], f"README.md block {block}", "exec"), {})


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert links
    missing = [link for link in links if not (Path(__file__).resolve().parents[1] / link).exists()]
    assert not missing
