"""A frozen record with some fields changed, for the path of every epoch."""

from __future__ import annotations

from typing import Any, TypeVar

T = TypeVar("T")

_set = object.__setattr__


def changed(record: T, **fields: Any) -> T:
    """`dataclasses.replace` for records with slots and no __post_init__, in a third of its time.

    Parameters
    ----------
    record : dataclass with slots
    **fields
        Names as in the record; another name is a TypeError.
    """
    new = object.__new__(type(record))
    names = record.__slots__  # type: ignore[attr-defined]
    for name in names:
        if name in fields:
            _set(new, name, fields.pop(name))
        else:
            _set(new, name, getattr(record, name))
    if fields:
        raise TypeError(f"{type(record).__name__} has no {', '.join(fields)}")
    return new
