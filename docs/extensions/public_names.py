"""The public names of the package, and the one page that each has."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from functools import cache
from types import ModuleType
from typing import Any

import cnfp_torchrl

# Modules that are public as they are; everything else is public in a package that lists it.
MODULES = ("cnfp_torchrl.distributions", "cnfp_torchrl.keys")


@cache
def rooms() -> dict[str, ModuleType]:
    """Return the packages that list public names, and the public modules, by name."""
    found = [cnfp_torchrl.__name__]
    for module in pkgutil.walk_packages(cnfp_torchrl.__path__, f"{cnfp_torchrl.__name__}."):
        if module.ispkg or module.name in MODULES:
            found.append(module.name)
    modules = {name: importlib.import_module(name) for name in found}
    return {name: module for name, module in modules.items() if names_in(module)}


def names_in(room: ModuleType) -> list[str]:
    """Return what a room makes public: what it lists, or else what it defines."""
    listed = getattr(room, "__all__", None)
    if listed is None and not hasattr(room, "__path__"):
        listed = [name for name in vars(room) if not name.startswith("_") and _is_own(room, name)]
    return sorted(name for name in listed or [] if not name.startswith("_"))


def _is_own(room: ModuleType, name: str) -> bool:
    value = getattr(room, name)
    if inspect.ismodule(value):
        return False
    return getattr(value, "__module__", room.__name__) == room.__name__


@cache
def home(room: str, name: str) -> str:
    """Return the full name under which a public name has its page.

    A name that several rooms make public has its page in the one that defines it, of rooms in each
    other the outermost but not the package itself: ``cnfp_torchrl.Ball`` and what
    ``cnfp_torchrl.geometry.ball`` defines are ``cnfp_torchrl.geometry.Ball``.
    """
    value = getattr(rooms()[room], name)
    defined_in = getattr(value, "__module__", room)
    package = cnfp_torchrl.__name__
    above = [other for other in rooms() if f"{defined_in}.".startswith(f"{other}.")]
    same = [
        other
        for other, module in rooms().items()
        if name in names_in(module) and getattr(module, name) is value
    ]
    best = min(same, key=lambda other: (other not in above, other == package, len(other)))
    return f"{best}.{name}"


def homes() -> Iterator[tuple[str, str, Any]]:
    """Yield the room, the name and the object of every page."""
    for room, module in rooms().items():
        for name in names_in(module):
            if home(room, name) == f"{room}.{name}":
                yield room, name, getattr(module, name)
