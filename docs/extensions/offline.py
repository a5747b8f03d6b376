"""A check that the built site loads nothing from another host: no script, style, font or image."""

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import SphinxError

ELSEWHERE = re.compile(r"\s*(?:https?:)?//", re.IGNORECASE)
IN_STYLE = re.compile(r"(?:url\(|@import)\s*[\"']?\s*(?:https?:)?//[^\"')]+", re.IGNORECASE)
# What a browser loads by itself; `a` is left out, which a reader has to follow.
LOADED = {"src", "srcset", "data", "poster"}


class ForeignResourceError(SphinxError):
    """A page of the site would load something from another host."""

    category = "Foreign resource"


def setup(app: Sphinx) -> dict[str, Any]:
    """Look at what was built when the build is done."""
    app.connect("build-finished", refuse_foreign_resources)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def refuse_foreign_resources(app: Sphinx, exception: Exception | None) -> None:
    """Raise when a file of the finished site loads something from another host."""
    if exception is None and (found := foreign_resources(Path(app.outdir))):
        raise ForeignResourceError("\n".join(found))


def foreign_resources(folder: Path) -> list[str]:
    """Return what pages and style sheets below a folder load from other hosts, with the file."""
    found = []
    for page in sorted(folder.rglob("*.html")):
        reader = _Resources()
        reader.feed(page.read_text(encoding="utf-8"))
        found += [f"{page.relative_to(folder)}: {address}" for address in reader.foreign]
    for sheet in sorted(folder.rglob("*.css")):
        text = sheet.read_text(encoding="utf-8")
        found += [f"{sheet.relative_to(folder)}: {address}" for address in IN_STYLE.findall(text)]
    return found


class _Resources(HTMLParser):
    """The resources from other hosts that a page names."""

    def __init__(self) -> None:
        super().__init__()
        self.foreign: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            loaded = name in LOADED or (tag in {"link", "image", "use"} and name.endswith("href"))
            if value and loaded and ELSEWHERE.match(value):
                self.foreign.append(f"<{tag} {name}={value}>")
            if value and name == "style":
                self.foreign += IN_STYLE.findall(value)

    def handle_data(self, data: str) -> None:
        if self.lasttag == "style":
            self.foreign += IN_STYLE.findall(data)
