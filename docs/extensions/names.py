"""References of docstrings, resolved as a reader of the code resolves them.

A name in single backticks is looked up among the public names, whatever module the docstring
stands in, and becomes a link to its page, as does a path such as ``docs/method.md``. What is no
public name, but a name all the same, is set as code: a parameter, a field, a method of an own
class, something of another library that can be imported. Anything else is no name of anything,
and reported. In pages that were written by hand, code that is a public name, or a call of one,
becomes a link.
"""

import importlib
import inspect
import sys
from collections.abc import Iterator
from functools import cache
from types import ModuleType
from typing import Any

from docutils import nodes
from public_names import homes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

PACKAGE = "cnfp_torchrl"


def setup(app: Sphinx) -> dict[str, Any]:
    """Resolve what Sphinx itself does not find."""
    app.connect("missing-reference", resolve)
    app.connect("doctree-resolved", link_code)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: nodes.Element
) -> nodes.Element | None:
    """Return a link, the name as code, or None where there is no such name."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"].removesuffix("()")
    from_page = node.get("refdoc", env.docname)
    page = target.removesuffix(".md")
    if page != target and page in env.found_docs:
        return make_refnode(app.builder, from_page, page, None, shown)
    objects = env.get_domain("py").objects  # type: ignore[attr-defined]
    first, _, rest = target.partition(".")
    for name in (_home_of(target), *(f"{home}.{rest}" for home in [_simple().get(first)] if home)):
        name = (name or "").removesuffix(".")
        if name in objects:
            entry = objects[name]
            return make_refnode(app.builder, from_page, entry.docname, entry.node_id, shown, name)
    if target in _identifiers() or _imported(target) is not None:
        return shown
    return shown if rest and any(_has(owner, rest) for owner in _named(first)) else None


def link_code(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Link code that is a public name, in pages that were written by hand."""
    if page.startswith("docs/api/"):
        return
    objects = app.env.get_domain("py").objects  # type: ignore[attr-defined]
    for code in list(doctree.findall(nodes.literal)):
        text = code.astext()
        name = text.removeprefix(f"{PACKAGE}.").partition("(")[0]
        # A single word in lower case may mean many things, unless it is called.
        means_it = "(" in text or name != name.lower() or "_" in name
        entry = objects.get(_simple().get(name, "")) if means_it else None
        if entry is not None and not isinstance(code.parent, nodes.reference):
            link = make_refnode(app.builder, page, entry.docname, entry.node_id, code.deepcopy())
            code.replace_self(link)


@cache
def _simple() -> dict[str, str]:
    """Return the full names of public names, by the names alone."""
    return {name: f"{room}.{name}" for room, name, _ in homes()}


def _home_of(target: str) -> str | None:
    """Return the full name of the page of what can be imported by a dotted name."""
    value = _imported(target) if "." in target else None
    if value is None:
        return None
    return next((f"{room}.{name}" for room, name, other in homes() if other is value), None)


@cache
def _imported(target: str) -> Any:
    """Return what a dotted name names, a built-in one without dots, or None."""
    module, path = "builtins", target.split(".")
    for length in range(len(path) - 1, 0, -1):
        try:
            importlib.import_module(".".join(path[:length]))
        except ImportError:
            continue
        module, path = ".".join(path[:length]), path[length:]
        break
    value: Any = sys.modules[module]
    for name in path:
        if not hasattr(value, name):
            try:
                return importlib.import_module(target)
            except (ImportError, ValueError):
                return None
        value = getattr(value, name)
    return value


def _named(name: str) -> Iterator[Any]:
    """Yield what a name stands for in any module of the package."""
    for module in _own_modules():
        if name in vars(module):
            yield vars(module)[name]


def _own_modules() -> list[ModuleType]:
    return [module for path, module in sys.modules.items() if path.split(".")[0] == PACKAGE]


def _has(owner: Any, name: str) -> bool:
    return hasattr(owner, name) or name in getattr(owner, "__annotations__", {})


@cache
def _identifiers() -> frozenset[str]:
    """Return all names of the package's modules, of its classes' members, and of parameters."""
    return frozenset(_walk())


def _walk() -> Iterator[str]:
    for module in _own_modules():
        for name, value in vars(module).items():
            yield name
            if getattr(value, "__module__", "").split(".")[0] != PACKAGE:
                continue
            yield from _parameters(value)
            if inspect.isclass(value):
                yield from dir(value)
                yield from getattr(value, "__annotations__", {})
                for member in vars(value).values():
                    yield from _parameters(member)


def _parameters(value: Any) -> Iterator[str]:
    if callable(value):
        try:
            yield from inspect.signature(value).parameters
        except (TypeError, ValueError):
            return
