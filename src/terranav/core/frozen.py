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
    known = 0
    for name in record.__slots__:  # type: ignore[attr-defined]
        if name in fields:
            _set(new, name, fields[name])
            known += 1
        else:
            _set(new, name, getattr(record, name))
    if known < len(fields):
        unknown = set(fields).difference(record.__slots__)  # type: ignore[attr-defined]
        raise TypeError(f"{type(record).__name__} has no {', '.join(sorted(unknown))}")
    return new
