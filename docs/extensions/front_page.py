"""The README as the site's first page: the table of contents, which it need not show, is added."""

from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

CONTENTS = Path(__file__).parents[1] / "_templates" / "contents.md"


def setup(app: Sphinx) -> dict[str, Any]:
    """Add to the README when it is read."""
    app.connect("source-read", add_contents)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page."""
    if page == app.config.root_doc:
        app.env.note_dependency(str(CONTENTS))
        source[0] += CONTENTS.read_text(encoding="utf-8")
