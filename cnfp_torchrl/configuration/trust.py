"""The check of a run's configuration, before anything that it names is called.

A configuration is a program: ``_target_`` names what is called, the keys beside it are the
arguments. A stranger's is read as plain data (`read_plain`), and refused unless every target and
argument in it may be used (`require_trusted`). A target is accepted for what it is, not for how its
name begins: a dotted name leads out of a package through any module that it imports.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, NoReturn

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cnfp_torchrl.configuration.directory import config_directory

BUILT = ("env", "flow", "network", "evaluation")
"""The sections of a run's configuration that are built again when the run is read."""

FOREIGN = ("torchrl.envs.GymEnv",)
"""The targets outside this package; none of them reads a file or runs code."""

_PACKAGE = __name__.partition(".")[0]

_SPECIAL = {
    "_args_": ("a list", lambda x: isinstance(x, list)),
    "_partial_": ("true or false", lambda x: isinstance(x, bool)),
    "_recursive_": ("true or false", lambda x: isinstance(x, bool)),
    "_convert_": (
        "one of none, partial, object, all",
        lambda x: x in ("none", "partial", "object", "all"),
    ),
}
"""Hydra's keys beside ``_target_``: the description of their values, and its test."""

# Dots only in numbers, and no separators, so that it names no file and no module's attribute.
_WORDS = ("words without slashes, colons and dots", re.compile(r"(?:[\w -]|(?<=\d)\.(?=\d))*"))
# No colon, before which Gymnasium takes the name of a module to import.
_ENVIRONMENT = ("a registered name without a module", re.compile(r"(?:[\w-]+/)?[\w.-]+"))
_TEXTS = {
    "_args_": _ENVIRONMENT,
    "env_name": _ENVIRONMENT,
    "backend": ("gym or gymnasium", re.compile("gym|gymnasium")),
    "device": ("a device such as cuda:0", re.compile(r"\w+(?::\d+)?")),
}
"""The pattern of a string by the name of the argument; of any other argument it is `_WORDS`."""


class DetourError(ValueError):
    """A dotted name leaves its package through a module that it imports."""


def read_plain(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file as plain data; nothing is resolved, built or imported.

    Raises:
        ValueError: when it is not YAML, has a tag or an alias, or is not a mapping.
    """
    expected = f"{path}: expected the plain YAML mapping that a training run writes"
    remedy = "copy the file anew from where the run was trained"
    try:
        text = path.read_text(encoding="utf-8")
        odd = next(_tags_and_aliases(text), None)
        content = None if odd else OmegaConf.to_container(OmegaConf.create(text))
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, RecursionError) as error:
        raise ValueError(f"{expected}, given something else: {error}; {remedy}") from error
    if odd or not isinstance(content, dict):
        raise ValueError(f"{expected}, given {odd or type(content).__name__}; {remedy}")
    return {str(name): value for name, value in content.items()}


def _tags_and_aliases(text: str) -> Iterator[str]:
    """Yield tags, which name types, and aliases, which multiply, with their lines."""
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        tag = getattr(event, "tag", None)
        if tag is not None or isinstance(event, yaml.AliasEvent):
            what = "an alias" if tag is None else f"the tag {tag}"
            yield f"{what} in line {event.start_mark.line + 1}"


def require_trusted(
    content: Mapping[Any, Any], trusted: Sequence[str], path: Path, *, trains: bool = False
) -> None:
    """Refuse a configuration that names another target, or passes another argument, than it may.

    Args:
        content: The configuration as plain data.
        trusted: The dotted names of further packages, modules or objects; what is defined in them
            may be named and gets any argument. The empty name trusts everything. A single one may
            be given as a string.
        path: The file, for the message.
        trains: Whether the run is to be trained further, which also calls what the shipped
            configuration names for training alone, such as PyTorch's optimizers.

    Raises:
        PermissionError: naming file, position, target or argument, and the remedy.
    """
    # A single name is no list of its letters.
    names = [trusted] if isinstance(trusted, str) else trusted or ()
    check = _Check(path, tuple(map(str.strip, names)), *(_shipped() if trains else ()))
    check.walk(content, "", "", is_limited=False)


@cache
def nameable() -> frozenset[str]:
    """Return every name that a run's configuration may use as a target without further trust.

    These are `FOREIGN`, the targets of the shipped configuration in the sections of `BUILT`, and
    the public classes of the same modules; all by their public names and by those of their
    definitions.
    """
    shipped = {name for name in _shipped_targets() if name.startswith(f"{_PACKAGE}.")}
    objects = {name: locate(name) for name in (*FOREIGN, *shipped)}
    for module in {name.rpartition(".")[0] for name in shipped}:
        members = vars(import_module(module))
        for name in members.get("__all__", members):
            if inspect.isclass(member := members[name]) and not name.startswith("_"):
                is_public = "__all__" in members or member.__module__ == module
                if is_public and _top(member.__module__) == _PACKAGE:
                    objects[f"{module}.{name}"] = member
    return frozenset(objects) | set(map(_home, objects.values()))


def foreign_packages(config: DictConfig) -> list[str]:
    """Return what whoever reads a run of a configuration has to trust, such as ``my_package.``."""
    content = OmegaConf.to_container(config, resolve=True)
    assert isinstance(content, dict)
    named = {str(target) for target in targets([content.get(name) for name in BUILT])} - nameable()
    return sorted({f"{_top(name)}." for name in named})


def locate(name: str) -> Any:
    """Return the object of a dotted name, imported as Hydra does, without leaving its package.

    Raises:
        DetourError: when the name leads through a module under another name than its own.
        ImportError: when there is nothing of this name.
    """
    first, *rest = name.split(".")
    found: Any = import_module(first)
    reached = first
    for part in rest:
        if isinstance(found, ModuleType) and found.__name__ != reached:
            raise DetourError(f"{reached} is the module {found.__name__}")
        is_module, reached = isinstance(found, ModuleType), f"{reached}.{part}"
        try:
            found = getattr(found, part)
        except AttributeError as error:
            if not is_module:
                raise ImportError(f"{reached} is not there") from error
            found = import_module(reached)
    return found


@cache
def _shipped() -> tuple[Mapping[str, frozenset[str]], frozenset[str]]:
    """Return the targets of the shipped configuration by section, and every text in it."""
    folder = config_directory()
    found: dict[str, set[str]] = {}
    texts: set[str] = set()
    for path in folder.rglob("*.yaml"):
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        group = path.relative_to(folder).parts[0]
        is_section = group not in (path.name, "experiment")
        for section, part in [(group, content)] if is_section else content.items():
            found.setdefault(section, set()).update(targets(part))
        texts.update(_texts(content))
    return {name: frozenset(values) for name, values in found.items()}, frozenset(texts)


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        for value in content:
            yield from _texts(value)
    elif isinstance(content, str):
        yield content


def _shipped_targets() -> Iterator[str]:
    folder = config_directory()
    for path in folder.rglob("*.yaml"):
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        if path.relative_to(folder).parts[0] in BUILT:
            yield from targets(content)
        else:
            yield from targets([content.get(section) for section in BUILT])


def targets(content: Any) -> Iterator[Any]:
    """Yield every target in plain data, at any depth."""
    inner: Iterable[Any] = content if isinstance(content, list) else ()
    if isinstance(content, dict):
        inner = content.values()
        if "_target_" in content:
            yield content["_target_"]
    for value in inner:
        yield from targets(value)


def _top(name: str) -> str:
    return name.partition(".")[0]


def _home(found: Any) -> str:
    """Return the name under which a class or function is defined."""
    return f"{getattr(found, '__module__', None)}.{getattr(found, '__qualname__', None)}"


class _Check:
    """The check of one configuration.

    Args:
        path: The file.
        trusted: The trusted names, see `require_trusted`.
        further: The targets that a section may name beside `nameable`, with limited arguments.
        texts: The strings that may be arguments whatever they are like.
    """

    def __init__(
        self,
        path: Path,
        trusted: tuple[str, ...],
        further: Mapping[str, frozenset[str]] = MappingProxyType({}),
        texts: frozenset[str] = frozenset(),
    ) -> None:
        self.path, self.trusted, self.further, self.texts = path, trusted, further, texts

    def refuse(self, position: str, expected: str, given: Any) -> NoReturn:
        raise PermissionError(
            f"{self.path}, {position.lstrip('.')}: expected {expected}, given {given!r}; nothing "
            "of the run was executed. If you trust whoever wrote it, name the package that defines "
            "what it needs: trusted=[my_package.] (cnfp-explain: --trusted my_package.)"
        )

    def walk(self, content: Any, position: str, name: str, *, is_limited: bool) -> None:
        """Check a value and everything in it.

        Args:
            content: The value.
            position: The value's dotted position in the file.
            name: The value's key, or that of the list that it is in.
            is_limited: Whether it is an argument of a target that the reader has not named.
        """
        if isinstance(content, dict):
            self.walk_mapping(content, position, is_limited=is_limited)
        elif isinstance(content, list):
            for i, value in enumerate(content):
                self.walk(value, f"{position}[{i}]", name, is_limited=is_limited)
        elif isinstance(content, str):
            if "${" in content:
                self.refuse(position, "a value without interpolation", content)
            expected, pattern = _TEXTS.get(name, _WORDS)
            if is_limited and not pattern.fullmatch(content) and content not in self.texts:
                self.refuse(position, expected, content)

    def walk_mapping(self, content: dict[Any, Any], position: str, *, is_limited: bool) -> None:
        if "_target_" in content:
            is_limited = not self.require_target(content["_target_"], f"{position}._target_")
        for key, value in content.items():
            name = str(key)
            inside = f"{position}.{name}"
            if "${" in name:
                self.refuse(inside, "a key without interpolation", name)
            if name in _SPECIAL:
                expected, fits = _SPECIAL[name]
                if not fits(value):
                    self.refuse(inside, expected, value)
            elif name != "_target_" and name.startswith("_") and (is_limited or name[-1] == "_"):
                self.refuse(inside, f"no key with an underscore but {list(_SPECIAL)}", name)
            if name != "_target_":
                self.walk(value, inside, name, is_limited=is_limited)

    def require_target(self, target: Any, position: str) -> bool:
        """Refuse a target that may not be named; return whether it may have any argument."""
        if isinstance(target, str):
            # Named by the reader: this very object, or everything.
            if "" in self.trusted or target in self.trusted:
                return True
            if any(target.startswith(f"{name.rstrip('.')}.") for name in self.trusted):
                return self.require_defined(target, position)
            section = position.lstrip(".").partition(".")[0]
            if target in nameable() or target in self.further.get(section, ()):
                return False
        which = " or ".join([*FOREIGN, *(f"what is defined in {name}" for name in self.trusted)])
        self.refuse(position, f"a target that the shipped configuration names, {which}", target)

    def require_defined(self, target: str, position: str) -> bool:
        """Refuse a name in a trusted package of something that is not defined there."""
        expected = f"a class or function that is defined in {_top(target)}"
        try:
            found = locate(target)
        except DetourError as error:
            self.refuse(position, f"{expected} (but {error})", target)
        except ImportError:
            # There is nothing to execute; Hydra says that it cannot be found.
            return True
        if _home(found) in nameable():
            return False
        if inspect.isclass(found) or (inspect.isroutine(found) and not isinstance(found, partial)):
            is_defined = _top(str(getattr(found, "__module__", None))) == _top(target)
        else:
            # Such as a functools.partial, which counts as defined where it is a module's attribute.
            is_defined = isinstance(locate(target.rpartition(".")[0]), ModuleType)
        if not is_defined or isinstance(found, ModuleType) or ".__" in target:
            self.refuse(position, expected, target)
        return True
