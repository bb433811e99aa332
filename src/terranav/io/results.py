"""Tables of arrays with metadata in one Parquet file: what a saved Result is made of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.io.files import read_parquet, replacing

_MARK = b"terranav.table"
_VERSION = b"1"


def write_result_table(
    path: str | Path, columns: Mapping[str, NDArray[Any]], metadata: Mapping[str, str | bytes]
) -> None:
    """Write arrays of one length and metadata to a Parquet file, replacing it in one go.

    Parameters
    ----------
    path : str or Path
    columns : mapping of name to (n,) array
        Numbers are stored as float64 (NaN stays NaN), texts as strings.
    metadata : mapping of text to text or bytes
        Text is stored as UTF-8.

    Raises
    ------
    DataError
        When an array is not one-dimensional, the lengths differ, or the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {key: np.asarray(value) for key, value in columns.items()}
    n = next((array.shape[0] for array in arrays.values() if array.ndim), 0)
    for key, array in arrays.items():
        if array.shape != (n,):
            raise DataError(f"{path}: column {key} has shape {array.shape}, expected ({n},) like the others")
        if array.dtype.kind not in "fiuU":
            raise DataError(f"{path}: column {key} is of type {array.dtype}, expected numbers or texts")
    encoded = {
        key: pa.array(array.tolist(), pa.string()) if array.dtype.kind == "U" else pa.array(array.astype(np.float64))
        for key, array in arrays.items()
    }
    facts = {key.encode(): value.encode() if isinstance(value, str) else value for key, value in metadata.items()}
    with replacing(path) as aside:
        pq.write_table(pa.table(encoded, metadata={**facts, _MARK: _VERSION}), aside)


def read_result_table(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, bytes]]:
    """Read what `write_result_table` wrote.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    columns : dict of name to (n,) array
        float64 or str.
    metadata : dict of text to bytes

    Raises
    ------
    DataError
        When the file is missing, cut, no Parquet file, or was not written by `write_result_table`.
    """
    import pyarrow as pa

    table = read_parquet(path, "a saved result (.parquet)")
    metadata = dict(table.schema.metadata or {})
    if metadata.pop(_MARK, None) != _VERSION:
        raise DataError(f"{path}: has no metadata {_MARK.decode()} = {_VERSION.decode()}, expected a saved result")
    columns: dict[str, NDArray[Any]] = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        if pa.types.is_float64(field.type):
            columns[field.name] = np.array(column.to_numpy(), dtype=np.float64)
        else:
            columns[field.name] = np.array(column.to_pylist(), dtype=np.str_)
    return columns, {key.decode(): value for key, value in metadata.items()}
