"""A page for every public name, from its docstring, and one for every room that has some."""

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from public_names import home, homes, names_in, rooms
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.inspect import signature, stringify_signature

FOLDER = Path("docs", "api")


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the pages before Sphinx looks for sources."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / FOLDER))
    app.connect("autodoc-process-docstring", describe_constant)
    app.connect("autodoc-skip-member", skip_undescribed_field)
    app.connect("autodoc-process-signature", sign_as_constructor)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(folder: Path) -> None:
    """Write the sources of all pages into a folder, and remove those of names that are gone."""
    pages = {"index.rst": _index_page()}
    pages |= {f"{room}.rst": _room_page(room) for room in shown_rooms()}
    for room, name, value in homes():
        pages[f"{room}.{name}.rst"] = _name_page(room, name, value)
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.rst"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / name
        # What has not changed keeps its time, so that Sphinx need not read it again.
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def shown_rooms() -> list[str]:
    """Return the rooms that have a page: the package, and those in which some names are at home.

    A room within a room whose names the outer one makes public needs no page.
    """
    with_pages = {room for room, _, _ in homes()}
    return [room for room in rooms() if room in with_pages or "." not in room]


def describe_constant(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Take a constant's docstring from the module that defines it, not from its type."""
    if what == "data":
        lines[:] = next(_constant_docstrings(name.rpartition(".")[2], value), [])


def skip_undescribed_field(
    app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out fields of named tuples that Python itself describes; the class describes them."""
    return True if str(getattr(value, "__doc__", "")).startswith("Alias for field") else None


def sign_as_constructor(
    app: Sphinx, what: str, name: str, value: Any, options: Any, arguments: str, returned: str
) -> tuple[str, str] | None:
    """Show the arguments of a class's constructor, which tensordict's metaclass hides."""
    if what != "class" or arguments != "(*args, **kwargs)":
        return None
    own = signature(value.__init__, bound_method=True)
    return stringify_signature(own, unqualified_typehints=True, short_literals=True), returned


def _constant_docstrings(name: str, value: Any) -> Iterator[list[str]]:
    for path, module in list(sys.modules.items()):
        if path.startswith("cnfp_torchrl.") and vars(module).get(name) is value:
            docstrings = ModuleAnalyzer.for_module(path).find_attr_docs()
            if ("", name) in docstrings:
                yield docstrings["", name]


def _index_page() -> str:
    """Return the table of rooms, and their pages for the sidebar."""
    table = "\n".join(f"   {room}" for room in shown_rooms())
    return (
        f"{_title('API')}Every public name has its page, from its docstring.\n\n"
        f".. autosummary::\n   :nosignatures:\n\n{table}\n\n"
        f".. toctree::\n   :hidden:\n\n{table}\n"
    )


def _room_page(room: str) -> str:
    """Return the room's docstring, a table of its names, and the pages of those at home here."""
    full_names = [home(room, name) for name in names_in(rooms()[room])]
    own = [name for name in full_names if name.rpartition(".")[0] == room]
    # Autosummary wants names without the module that it stands in.
    table = "\n".join(f"   ~{name.removeprefix(f'{room}.')}" for name in full_names)
    return (
        f"{_title(room)}.. automodule:: {room}\n   :no-members:\n\n"
        f".. autosummary::\n   :nosignatures:\n\n{table}\n\n"
        + (".. toctree::\n   :hidden:\n\n" + "\n".join(f"   {name}" for name in own) if own else "")
        + "\n"
    )


def _name_page(room: str, name: str, value: Any) -> str:
    if inspect.isclass(value):
        kind, options = "class", "   :members:\n   :show-inheritance:\n"
        if issubclass(value, BaseException):
            kind, options = "exception", ""
    elif inspect.isroutine(value) or hasattr(value, "__wrapped__"):
        kind, options = "function", ""
    else:
        kind, options = "data", ""
    return f"{_title(name)}.. auto{kind}:: {room}.{name}\n{options}"


def _title(name: str) -> str:
    return f"{name}\n{'=' * len(name)}\n\n"
