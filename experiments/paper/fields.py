"""Reading a JSON file that is not trusted, field by field."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn


class RecordError(ValueError):
    """A file is not what it should be."""


class Fields:
    """The fields of a JSON object, each taken once and checked for its kind.

    Args:
        path: the file, for messages.
        name: of the object within the file, empty for the whole.
        content: the object.
    """

    def __init__(self, path: Path, name: str, content: Mapping[str, Any]) -> None:
        self._path = path
        self._name = name
        self._left = dict(content)

    @classmethod
    def read(cls, path: Path) -> Fields:
        """Return the fields of a file.

        Raises:
            RecordError: when it cannot be read, or is not one JSON object with finite numbers.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
        except (OSError, ValueError) as error:
            raise RecordError(f"{path}: expected a JSON file, but reading fails: {error}") from None
        if not isinstance(content, dict):
            raise RecordError(f"{path}: expected a JSON object, given {type(content).__name__}")
        return cls(path, "", content)

    def error(self, name: str, message: str) -> RecordError:
        """Return the error to raise about a field."""
        return RecordError(f"{self._path}: {self._full(name)}: {message}")

    def take(self, name: str) -> Any:
        """Return a field of any kind; each further method returns one of its kind or raises."""
        if name not in self._left:
            raise self.error(name, "expected this field, but it is missing")
        return self._left.pop(name)

    def nothing_left(self) -> None:
        """Refuse fields that nobody asked for: they are of another format."""
        if self._left:
            raise self.error(", ".join(self._left), "expected no such field")

    def text(self, name: str) -> str:
        """Return a text that is not empty."""
        value = self.take(name)
        return value if _is_text(value) else self._wrong(name, "a text", value)

    def texts(self, name: str) -> list[str]:
        """Return a list of texts."""
        value = self.take(name)
        good = isinstance(value, list) and all(_is_text(each) for each in value)
        return value if good else self._wrong(name, "a list of texts", value)

    def number(self, name: str) -> float:
        """Return a finite number."""
        value = self.take(name)
        return value if _is_number(value) else self._wrong(name, "a finite number", value)

    def numbers(self, name: str) -> list[float]:
        """Return a list of finite numbers."""
        value = self.take(name)
        good = isinstance(value, list) and all(_is_number(each) for each in value)
        return value if good else self._wrong(name, "a list of finite numbers", value)

    def whole(self, name: str) -> int:
        """Return a whole number that is not negative."""
        value = self.take(name)
        return value if _is_count(value) else self._wrong(name, "a whole number >= 0", value)

    def wholes(self, name: str) -> list[int]:
        """Return a list of whole numbers that are not negative."""
        value = self.take(name)
        good = isinstance(value, list) and all(_is_count(each) for each in value)
        return value if good else self._wrong(name, "a list of whole numbers >= 0", value)

    def mapping(self, name: str) -> Mapping[str, Any]:
        """Return an object as it is."""
        value = self.take(name)
        return value if isinstance(value, dict) else self._wrong(name, "an object", value)

    def counts(self, name: str) -> dict[str, int]:
        """Return an object of whole numbers that are not negative."""
        value = dict(self.mapping(name))
        good = all(_is_count(each) for each in value.values())
        return value if good else self._wrong(name, "an object of whole numbers >= 0", value)

    def part(self, name: str) -> Fields:
        """Return the fields of an object."""
        return Fields(self._path, self._full(name), self.mapping(name))

    def parts(self, name: str) -> dict[str, Fields]:
        """Return the fields of each object of an object."""
        inner = self.part(name)
        return {each: inner.part(each) for each in list(inner._left)}

    def _full(self, name: str) -> str:
        return f"{self._name}.{name}" if self._name else name

    def _wrong(self, name: str, expected: str, given: Any) -> NoReturn:
        shown = repr(given)
        shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
        raise self.error(name, f"expected {expected}, given {shown}")


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a finite number")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_number(value: Any) -> bool:
    # A whole number may be too large for math.isfinite, which converts it.
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and -sys.float_info.max <= value <= sys.float_info.max


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
