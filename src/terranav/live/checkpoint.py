"""A checkpoint: the state of an engine as bytes that can be trusted to be whole, and to belong here.

    TNAVLIVE, version, SHA-256 of all that follows, digest of settings and maps, pickled state

Settings and maps are not in it, only their digest. A pickle can name any function; from a checkpoint only records and
arrays are made.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from typing import Any

from terranav.core.errors import ConfigError, DataError
from terranav.live.settings import LiveSettings

_MAGIC = b"TNAVLIVE"
_VERSION = b"\x01"
_HASH, _DIGEST = 32, 64
_SETTINGS = "settings"
_ARRAYS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pcg64", "PCG64"),
    ("numpy.random.bit_generator", "SeedSequence"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "bytearray"),
    ("collections", "deque"),
    ("copyreg", "_reconstructor"),
    ("builtins", "object"),
}


def packed(state: Any, digest: str, settings: LiveSettings) -> bytes:
    """A state as bytes."""
    buffer = io.BytesIO()
    _Pickler(buffer, settings).dump(state)
    body = digest.encode() + buffer.getvalue()
    return _MAGIC + _VERSION + hashlib.sha256(body).digest() + body


def unpacked(data: bytes, digest: str, settings: LiveSettings) -> Any:
    """The state in bytes that `packed` made.

    Raises
    ------
    DataError
        The bytes are damaged, or no checkpoint.
    ConfigError
        It belongs to other settings or maps.
    """
    head = len(_MAGIC) + len(_VERSION)
    if data[: len(_MAGIC)] != _MAGIC:
        raise DataError(f"checkpoint begins with {data[:8]!r}, expected {_MAGIC!r}")
    if data[len(_MAGIC) : head] != _VERSION:
        raise DataError(f"checkpoint is of version {data[len(_MAGIC) : head]!r}, expected {_VERSION!r}")
    body = data[head + _HASH :]
    if hashlib.sha256(body).digest() != data[head : head + _HASH]:
        raise DataError("checkpoint is damaged: its checksum is another, expected a whole one")
    if body[:_DIGEST].decode("ascii", "replace") != digest:
        raise ConfigError("checkpoint belongs to other settings or maps, expected those that it was made with")
    try:
        return _Unpickler(io.BytesIO(body[_DIGEST:]), settings).load()
    except (
        pickle.UnpicklingError,
        AttributeError,
        EOFError,
        ImportError,
        IndexError,
        TypeError,
        ValueError,
    ) as problem:
        raise DataError(f"checkpoint cannot be read ({problem}), expected one of this version of terranav") from None


class _Pickler(pickle.Pickler):
    """Leaves the settings out."""

    def __init__(self, buffer: io.BytesIO, settings: LiveSettings) -> None:
        super().__init__(buffer, protocol=5)
        self._settings = settings

    def persistent_id(self, obj: Any) -> str | None:
        """A name for what is not pickled."""
        return _SETTINGS if obj is self._settings else None


class _Unpickler(pickle.Unpickler):
    """Makes records and arrays alone."""

    def __init__(self, buffer: io.BytesIO, settings: LiveSettings) -> None:
        super().__init__(buffer)
        self._settings = settings

    def persistent_load(self, pid: Any) -> Any:
        """What was not pickled."""
        if pid != _SETTINGS:
            raise pickle.UnpicklingError(f"unknown part {pid!r}")
        return self._settings

    def find_class(self, module: str, name: str) -> Any:
        """A record of terranav's, or what an array or a generator is made of."""
        found = (
            super().find_class(module, name) if module.startswith("terranav.") or (module, name) in _ARRAYS else None
        )
        if found is None or (module.startswith("terranav.") and not isinstance(found, type)):
            raise pickle.UnpicklingError(f"{module}.{name} does not belong in a checkpoint")
        return found
