"""The rows of a DataFlash log (.BIN) as columns: where each message stands, and its fields as numbers.

A log is a chain of messages: 0xA3 0x95, a type, and as many bytes as the FMT message of that type said. What the
letters of a format mean is pymavlink's (DFFormat); the walk along the chain is done here because pymavlink's own loses
the log at one damaged FMT, and takes a step and prints a line for every damaged byte.
"""

from __future__ import annotations

import mmap
import struct
from array import array
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.io.logs.raw import GIVE_UP_BYTES, SPARE_BYTES, library, mapped

_HEAD = b"\xa3\x95"
_FMT, _FMT_BYTES = 0x80, 89
_MAX_MESSAGE = 255


@dataclass(eq=False)
class Rows:
    """The wanted messages of a log.

    Attributes
    ----------
    tables : dict
        By name of the message: a mapping of field to array (n,), with the multiplier of its format letter applied;
        '_offset' is where each stood in the file.
    parameters : dict
        By name, the last value of each.
    counts : dict
        How many messages of each name there are, of all.
    damaged : int
        Bytes that belong to no message.
    zeros : int
        Zero bytes at the end: a file that was given its size beforehand.
    unread : int
        Bytes at the end that were not read: the file is cut there, or holds nothing that could be a message.
    """

    tables: dict[str, dict[str, NDArray[Any]]] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    texts: list[str] = field(default_factory=list)
    damaged: int = 0
    zeros: int = 0
    unread: int = 0


def read_rows(path: Path, wanted: Collection[str]) -> Rows:
    """Read the messages of these names, and the parameters (PARM).

    Raises
    ------
    DataError
        When the file cannot be read or holds only zeros.
    ConfigError
        When pymavlink is not installed.
    """
    reader = library("pymavlink.DFReader", path, "a DataFlash log (.BIN)")
    with mapped(path) as (data, zeros):
        rows = Rows()
        formats, offsets = _walk(data, reader, rows)
        rows.zeros += zeros
        for name, places in offsets.items():
            rows.counts[name] = len(places)
            if name in wanted or name in ("PARM", "MSG"):
                _decode(data, formats[name], places, name, rows)
    return rows


def _walk(data: mmap.mmap, reader: Any, rows: Rows) -> tuple[dict[str, Any], dict[str, Any]]:
    """Every format by name and the offsets of its messages; counts the bytes that belong to none."""
    lengths: list[int] = [0] * 256
    lengths[_FMT] = _FMT_BYTES
    names: list[str] = [""] * 256
    offsets: list[Any] = [array("Q") for _ in range(256)]
    formats: dict[str, Any] = {}
    at, size, last_good = 0, len(data), 0
    while at + 3 <= size:
        head = data[at : at + 3]
        length = lengths[head[2]] if head[:2] == _HEAD else 0
        if length and at + length <= size and _follows(data, at + length, size):
            if head[2] == _FMT:
                _learn(data[at + 3 : at + length], reader, lengths, names, formats)
            offsets[head[2]].append(at)
            at += length
            last_good = at
            continue
        after = data.find(_HEAD, at + 1, last_good + GIVE_UP_BYTES)
        if after < 0:
            break
        rows.damaged += after - at
        at = after
    rows.damaged -= at - last_good if at > last_good else 0
    if size - last_good > SPARE_BYTES or any(data[last_good:size]):
        rows.unread = size - last_good
    else:
        rows.zeros = size - last_good
    return formats, {names[i]: offsets[i] for i in range(256) if names[i] and len(offsets[i])}


def _follows(data: mmap.mmap, at: int, size: int) -> bool:
    """Whether a message can begin here: its head, or the file's end, or the zeros after which it was cut."""
    after = data[at : at + 2]
    return after == _HEAD or at + 2 > size or after == b"\0\0"


def _learn(body: bytes, reader: Any, lengths: list[int], names: list[str], formats: dict[str, Any]) -> None:
    """Take up a FMT message; one that contradicts itself is damage and is passed over."""
    kind, length, name, letters, columns = struct.unpack("<BB4s16s64s", body)
    try:
        texts = [part.split(b"\0", 1)[0].decode("ascii") for part in (name, letters, columns)]
        made = reader.DFFormat(kind, texts[0], length, texts[1], texts[2])
        fits = struct.calcsize(made.msg_struct) + 3 == length and len(made.columns) == len(texts[1])
    except Exception:  # noqa: BLE001 - DFFormat raises Exception itself for an unknown letter
        return
    if not fits or not texts[0] or (kind == _FMT and length != _FMT_BYTES) or length > _MAX_MESSAGE:
        return
    if names[kind] and names[kind] != texts[0]:
        return
    lengths[kind], names[kind], formats[texts[0]] = length, texts[0], made


def _decode(data: mmap.mmap, made: Any, places: Any, name: str, rows: Rows) -> None:
    """The fields of every message of one format as columns."""
    size = struct.calcsize(made.msg_struct)
    offsets = np.frombuffer(places, dtype=np.uint64).astype(np.int64)
    kind = np.dtype([(column, _dtype(letter)) for column, letter in zip(made.columns, made.format, strict=True)])
    body = b"".join(data[at + 3 : at + 3 + size] for at in places)
    table = np.frombuffer(body, dtype=kind)
    fields: dict[str, NDArray[Any]] = {"_offset": offsets}
    for column, multiplier in zip(made.columns, made.msg_mults, strict=True):
        values = table[column]
        # dividing by 1e7 is exact to the last bit where multiplying by 1e-7 is not
        fields[column] = values if multiplier is None else values / round(1.0 / multiplier)
    if name == "PARM" and {"Name", "Value"} <= fields.keys():
        names = [text.split(b"\0", 1)[0].decode("ascii", "replace") for text in fields["Name"].tolist()]
        rows.parameters = dict(zip(names, fields["Value"].astype(float).tolist(), strict=True))
    elif name == "MSG" and "Message" in fields:
        rows.texts = [text.split(b"\0", 1)[0].decode("ascii", "replace") for text in fields["Message"][:50].tolist()]
    else:
        rows.tables[name] = fields


def _dtype(letter: str) -> str:
    """The numpy type of a format letter (AP_Logger/LogStructure.h)."""
    texts = {"a": "S64", "n": "S4", "N": "S16", "Z": "S64"}
    numbers = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"}
    scaled = {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"}
    return (texts | numbers | scaled | {"f": "<f4", "d": "<f8", "g": "<f2"})[letter]
