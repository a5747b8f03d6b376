"""Pages that are read in the repository as well as on the site.

The README is the site's first page; the table of contents, which it need not show, is added. A link
to a folder of the repository, which the site has no page for, becomes plain text.
"""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

CONTENTS = Path(__file__).parents[1] / "_templates" / "contents.md"


def setup(app: Sphinx) -> dict[str, Any]:
    """Change pages when they are read."""
    app.connect("source-read", add_contents)
    app.connect("doctree-read", unlink_folders)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page."""
    if page == app.config.root_doc:
        app.env.note_dependency(str(CONTENTS))
        source[0] += CONTENTS.read_text(encoding="utf-8")


def unlink_folders(app: Sphinx, doctree: nodes.document) -> None:
    """Leave of a link to a folder that exists its text."""
    page = Path(app.env.doc2path(app.env.docname))
    for link in list(doctree.findall(pending_xref)):
        if link.get("reftype") == "myst" and (page.parent / link["reftarget"]).is_dir():
            link.replace_self(link.children)
