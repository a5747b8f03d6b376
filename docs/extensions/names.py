"""References of docstrings, resolved as a reader of the code resolves them.

A name in single backticks is looked up among the public names, whatever module the docstring stands
in, and becomes a link to its page. What is no public name, but a name all the same, is set as code:
a parameter, a field, a method of an own class, something of another library that can be imported.
A path such as ``docs/method.md`` becomes a link to the page.
Anything else is no name of anything, and reported.
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
                for base in value.__mro__:
                    yield from getattr(base, "__annotations__", {})
                for member in dir(value):
                    yield member
                    yield from _parameters(inspect.getattr_static(value, member, None))


def _parameters(value: Any) -> Iterator[str]:
    if callable(value):
        try:
            yield from inspect.signature(value).parameters
        except (TypeError, ValueError):
            return
