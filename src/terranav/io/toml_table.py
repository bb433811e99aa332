"""Reading a TOML file key by key, with errors that name the file, the key, the value and what was expected."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from terranav.core.checks import finite, nearest_name
from terranav.core.errors import ConfigError, TerranavError
from terranav.io.files import existing_file


class TomlTable:
    """One table of a TOML (or JSON) file.

    Each getter returns the value of a key, or None where it is absent, and raises when it has the wrong type. `close`
    raises for the keys that no getter asked for: so the known keys are written down once, where they are read.

    Parameters
    ----------
    values : mapping
    where : str
        The file, for messages.
    error : type of exception
        DataError for files of data, ConfigError for files of settings.
    label : str
        The table's own name, such as '[rows]'; empty for the top of the file.
    """

    def __init__(self, values: Mapping[str, Any], where: str, error: type[TerranavError], label: str = "") -> None:
        self._values = values
        self._asked: set[str] = set()
        self.where = where
        self.error = error
        self.label = label

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def given(self) -> list[str]:
        """Every key that the file gives."""
        return list(self._values)

    def value(self, key: str) -> Any:
        """The value as it stands, of any type."""
        self._asked.add(key)
        return self._values.get(key)

    def text(self, key: str, expected: str = "a text") -> str | None:
        """A text."""
        value = self.value(key)
        if value is not None and not isinstance(value, str):
            self.fail(key, expected)
        return value

    def choice(self, key: str, choices: Iterable[str], default: str) -> str:
        """One of a few words, `default` where the key is absent."""
        value, words = self.value(key), list(choices)
        if value is None:
            return default
        if value not in words:
            near = nearest_name(value, words) if isinstance(value, str) else ""
            self.fail(key, f"one of {', '.join(words)}{near}")
        return str(value)

    def flag(self, key: str, default: bool) -> bool:
        """True or false, `default` where the key is absent."""
        value = self.value(key)
        if value is not None and not isinstance(value, bool):
            self.fail(key, "true or false")
        return default if value is None else value

    def number(self, key: str, default: float, **limits: float) -> float:
        """A finite number within the limits of `core.checks.finite`, `default` where the key is absent."""
        value = self.value(key)
        if value is None:
            return default
        try:
            return finite(f"{self.where}: {self._named(key)}", value, **limits)
        except ConfigError as problem:
            raise self.error(str(problem)) from None

    def count(self, key: str, default: int) -> int:
        """A whole number that is not negative, `default` where the key is absent."""
        value = self.value(key)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            self.fail(key, "a whole number >= 0")
        return int(value)

    def texts(self, key: str) -> list[str] | None:
        """A list of texts."""
        value = self.value(key)
        if value is not None and not (isinstance(value, list) and all(isinstance(item, str) for item in value)):
            self.fail(key, 'a list of texts such as ["a", "b"]')
        return value

    def nulls(self, key: str) -> list[str | float]:
        """A list of texts and numbers that mean 'no reading', empty where the key is absent."""
        value = self.value(key)
        good = isinstance(value, list) and all(
            isinstance(v, (str, int, float)) and not isinstance(v, bool) for v in value
        )
        if value is not None and not good:
            self.fail(key, 'a list of numbers and texts such as [-9999.99, "*"]')
        return value or []

    def table(self, key: str) -> TomlTable | None:
        """A table within this one."""
        value = self.value(key)
        if value is None:
            return None
        if not isinstance(value, dict):
            self.fail(key, f"a table [{key}]")
        return self.inner(value, f"{self.label} {key}" if self.label else f"[{key}]")

    def inner(self, values: Mapping[str, Any], label: str) -> TomlTable:
        """A table of the same file."""
        return TomlTable(values, self.where, self.error, label)

    def fail(self, key: str, expected: str) -> NoReturn:
        """Raise for the value of a key."""
        raise self.error(f"{self.where}: {self._named(key)} is {self._values[key]!r}, expected {expected}")

    def unknown(self, key: str, known: Iterable[str]) -> NoReturn:
        """Raise for a key that is not among the known ones, offering the nearest."""
        names = list(known)
        near, among = nearest_name(key, names), f"; known: {', '.join(names)}" if names else ""
        raise self.error(f"{self.where}: unknown key {self._named(key)!r}{near}{among}")

    def missing(self, key: str, expected: str) -> NoReturn:
        """Raise for a key that must be there."""
        raise self.error(f"{self.where}: {self._named(key)} is missing, expected {expected}")

    def close(self) -> None:
        """Raise for the first key that nobody asked for."""
        for key in self._values:
            if key not in self._asked:
                self.unknown(key, sorted(self._asked))

    def _named(self, key: str) -> str:
        """The key with the table it stands in."""
        return f"{self.label} {key}" if self.label else key


def read_toml(path: str | Path, what: str, error: type[TerranavError]) -> TomlTable:
    """Read a TOML file.

    Parameters
    ----------
    path : str or Path
    what : str
        What the file should be, for messages.
    error : type of exception
        Raised, with one line, when the file is missing, a folder, empty or not valid TOML, and by the table's getters.
    """
    file = existing_file(path, what, error)
    try:
        return TomlTable(tomllib.loads(file.read_text(encoding="utf-8-sig")), str(path), error)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{path}: is not valid TOML: {problem}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not a UTF-8 text, expected {what}") from None
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror}), expected {what}") from None
