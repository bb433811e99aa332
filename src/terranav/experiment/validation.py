"""pydantic's complaints as the house's one line: file, table, key, value seen, what was expected."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from terranav.core.checks import nearest_name
from terranav.core.errors import ConfigError

_SHOWN = 60  # characters of a value that a message shows


def validated(model: type[BaseModel], values: Mapping[str, Any], where: str) -> Any:
    """Return `values` as a `model`, or raise ConfigError for the first thing that is wrong.

    Parameters
    ----------
    model : type of BaseModel
        Each field says in `json_schema_extra["expected"]` what its value should be.
    values : mapping
        Nested tables, as tomllib gives them.
    where : str
        The file, for the message.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        # an unknown key often explains why another one is missing
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        raise ConfigError(f"{where}: {_line(model, values, first)}") from None


def unknown_key(key: str, known: list[str]) -> str:
    """Text of the complaint about a key, offering the nearest known one."""
    return f"unknown key {key!r}{nearest_name(key, known)}; known: {', '.join(known)}"


def _line(model: type[BaseModel], values: Mapping[str, Any], error: Any) -> str:
    """One complaint as text."""
    path, owner, value = _walk(model, values, error["loc"])
    if error["type"] == "extra_forbidden":
        return f"{_table(path[:-1])}{unknown_key(str(path[-1]), list(owner.model_fields))}"
    if error["type"] == "value_error":  # raised by a check of our own: it names the key itself
        message = str(error["ctx"]["error"])
        last = next((part for part in reversed(path) if isinstance(part, str)), "")
        return f"{_table(path)}{message.removeprefix(f'{last} ')}"
    field = owner.model_fields[str(path[-1])]
    extra = field.json_schema_extra
    expected = extra["expected"] if isinstance(extra, dict) else "another value"
    if error["type"] == "missing":
        return f"{_table(path[:-1])}{path[-1]} is missing, expected {expected}"
    return f"{_table(path[:-1])}{path[-1]} is {_shown(value)}, expected {expected}"


def _walk(
    model: type[BaseModel], values: Any, loc: tuple[int | str, ...]
) -> tuple[list[int | str], type[BaseModel], Any]:
    """Follow an error's place down to the last key of ours: its path, the model that has it, and the value there."""
    path: list[int | str] = []
    owner, value = model, values
    inner: type[BaseModel] | None = model
    for part in loc:
        if inner is None:  # below a plain value: pydantic names elements, and branches of a union
            break
        path.append(part)
        if isinstance(part, int):
            value = value[part]
            continue
        owner, value = inner, value.get(part)
        field = owner.model_fields.get(part)
        inner = None if field is None else _model_in(field.annotation)
    return path, owner, value


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field's annotation holds, None for a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := _model_in(part)) is not None), None)


def _table(path: list[int | str]) -> str:
    """TOML's name of a table with a space behind it; empty for the top of the file."""
    names = [str(part) for part in path if isinstance(part, str)]
    number = next((part for part in path if isinstance(part, int)), None)
    if not names:
        return ""
    return f"[{'.'.join(names)}] " if number is None else f"[[{'.'.join(names)}]] {number + 1}: "


def _shown(value: Any) -> str:
    """A value as TOML would write it, shortened."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def toml_values(path: str | Path, what: str) -> tuple[Path, dict[str, Any]]:
    """The file at `path` and its tables; ConfigError where it is missing or no TOML. `what` is what was expected."""
    from terranav.io.files import existing_file

    file = existing_file(path, f"{what} (.toml)", ConfigError)
    try:
        return file, tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{file}: is no TOML file ({error}), expected {what}") from None
