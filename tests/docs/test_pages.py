"""The pages' code runs as it stands there, and their links lead somewhere."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import cnfp_torchrl

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINKED = [*PAGES, ROOT / ".github" / "CONTRIBUTING.md", *sorted(ROOT.glob("experiments/**/*.md"))]
# One block continues the other there: they have tests of their own.
IN_ONE_PIECE = {"families.md", "own_environment.md"}
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    if page.name not in IN_ONE_PIECE
    for number, block in enumerate(
        re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    )
]


@pytest.mark.parametrize("block", BLOCKS)
def test_code_block_runs(block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "block", "exec"), {"__name__": "block"})


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", page.read_text())
    # The API's pages are written when the site is built, which checks them.
    links = [link for link in links if not link.startswith("api/")]
    assert not [link for link in links if not (page.parent / link).exists()]


def test_readme_says_it_in_ten_lines() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", PAGES[0].read_text(), flags=re.DOTALL)
    lines = [line for line in block.splitlines() if line and not re.match(r"(from|import) ", line)]
    assert len(lines) <= 10


@pytest.mark.parametrize(
    "words",
    [
        "state-dependent action bounds",
        "continuous action masking",
        "safe reinforcement learning",
        "hard constraints",
        "TorchRL",
    ],
)
def test_readme_has_the_words_that_people_search_for(words: str) -> None:
    assert words.lower() in " ".join(PAGES[0].read_text().split()).lower()


def test_the_map_of_the_house_has_its_rooms_in_the_linters_order() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (layers,) = (
        contract["layers"]
        for contract in settings["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers"
    )
    ranks = {
        room.strip("() ").removeprefix("cnfp_torchrl."): -rank
        for rank, layer in enumerate(layers)
        for room in layer.split(":")
    }
    text = (ROOT / ".github" / "CONTRIBUTING.md").read_text()
    shown = re.findall(r"^\| `(\w+)(?:/|\.py)` \|", text, flags=re.MULTILINE)
    packages = {path.parent.name for path in (ROOT / "cnfp_torchrl").glob("*/__init__.py")}
    assert packages <= set(shown) <= ranks.keys()
    assert [ranks[room] for room in shown] == sorted(ranks[room] for room in shown)


def test_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "docs" / "CITATION.cff").read_text())
    assert citation["version"] == cnfp_torchrl.__version__


def test_issue_templates_ask_for_something() -> None:
    templates = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert templates
    for template in templates:
        form = yaml.safe_load(template.read_text())
        assert {"name", "description", "body"} <= form.keys()
        assert any(field.get("validations", {}).get("required") for field in form["body"])
