"""Recordings in files: CSV with a TOML file of the same name beside it, or Parquet with the same facts in its metadata.

One row per epoch, the columns of `core.recording.COLUMNS`, an empty cell (a null) where there is no reading. Both
formats give back every float64 to the bit.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from terranav.core.checks import nearest_name
from terranav.core.errors import DataError
from terranav.core.recording import COLUMNS, FloatArray, Recording
from terranav.io.files import existing_file, read_parquet, replacing
from terranav.io.sidecar import About, about_from, facts_of, toml_text
from terranav.io.text_table import finite_or_nan, read_text_table
from terranav.io.toml_table import TomlTable, read_toml

_WHAT = "a recording (.csv or .parquet)"
_METADATA_KEY = b"terranav.recording"


def read_recording(path: str | Path) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path : str or Path
        A .csv file, with or without a .toml file of the same name beside it, or a .parquet file.

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        One line that names the file, the column or key, the row, the value seen and what was expected.
    """
    file = existing_file(path, _WHAT)
    if _suffix(file) == ".csv":
        columns, about = _read_csv(file), _read_sidecar(file)
    else:
        columns, about = _read_parquet(file)
    name = file.stem if about.name is None else about.name
    try:
        return Recording(columns, about.ins, about.sigma, about.source, name, about.datum)
    except DataError as problem:
        raise DataError(f"{path}: {str(problem).removeprefix(f'{name}: ')}") from None


def write_recording(rec: Recording, path: str | Path) -> None:
    """Write a recording so that `read_recording` gives it back to the bit.

    Parameters
    ----------
    rec : Recording
    path : str or Path
        Ends in .csv (a .toml file of the same name is written beside it) or .parquet. The files are replaced in one go.

    Raises
    ------
    DataError
        When the suffix is another, the folder cannot be written, or the .toml file beside the CSV is there already and
        does not belong to a recording.
    """
    file = Path(path)
    if _suffix(file) == ".csv":
        _read_sidecar(file, "would be overwritten, but ")
        with replacing(file) as csv_aside, replacing(file.with_suffix(".toml")) as toml_aside:
            _write_csv(rec, csv_aside)
            toml_aside.write_text(toml_text(facts_of(rec)), encoding="utf-8", newline="\n")
    else:
        with replacing(file) as aside:
            _write_parquet(rec, aside)


def _suffix(file: Path) -> str:
    """'.csv' or '.parquet'."""
    suffix = file.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise DataError(f"{file}: the name ends in {file.suffix!r}, expected {_WHAT}; other tables: terranav convert")
    return suffix


def _read_csv(file: Path) -> dict[str, FloatArray]:
    """The columns of a CSV file; their names are checked before any cell is read."""
    table = read_text_table(file, _WHAT)
    for name in table.names:
        if name not in COLUMNS:
            seen = name if len(name) < 60 else f"{name[:60]}..."
            known = ", ".join(COLUMNS)
            raise DataError(f"{file}: unknown column {seen!r}{nearest_name(name, COLUMNS)}; known: {known}")
    return {name: table.numbers(name) for name in table.names}


def _read_sidecar(file: Path, before: str = "") -> About:
    """The facts beside a CSV file, nothing where there is no such file."""
    sidecar = file.with_suffix(".toml")
    if not sidecar.exists():
        return About()
    try:
        table = read_toml(sidecar, f"what is constant over {file.name}", DataError)
        about = about_from(table)
        table.close()
    except DataError as problem:
        text = str(problem).removeprefix(f"{sidecar}: ")
        raise DataError(f"{sidecar}: {before}{text}") from None
    return about


def _write_csv(rec: Recording, path: Path) -> None:
    """One line of names, one line per epoch."""
    cells = [[finite_or_nan(value) for value in column.tolist()] for column in rec.columns.values()]
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(rec.columns) + "\n")
        stream.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))


def _read_parquet(file: Path) -> tuple[dict[str, FloatArray], About]:
    """The columns and the facts of a Parquet file."""
    import pyarrow as pa

    table = read_parquet(file, _WHAT)
    columns = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type) or pa.types.is_null(field.type)):
            raise DataError(f"{file}: column {field.name} is of type {field.type}, expected numbers")
        columns[field.name] = np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)
    return columns, _about_metadata(file, table.schema.metadata or {})


def _about_metadata(file: Path, metadata: Mapping[bytes, bytes]) -> About:
    """The facts in a Parquet file's metadata, nothing where they are absent."""
    if _METADATA_KEY not in metadata:
        return About()
    where = f"{file} (metadata {_METADATA_KEY.decode()})"
    try:
        facts: Any = json.loads(metadata[_METADATA_KEY])
    except ValueError as problem:
        raise DataError(f"{where}: is not valid JSON: {problem}") from None
    if not isinstance(facts, dict):
        raise DataError(f"{where}: is {facts!r}, expected an object with name, ins, sigma, source, vertical_datum")
    table = TomlTable(facts, where, DataError)
    about = about_from(table)
    table.close()
    return about


def _write_parquet(rec: Recording, path: Path) -> None:
    """A float64 column each, null where there is no reading."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {key: pa.array(column, from_pandas=True) for key, column in rec.columns.items()}
    metadata = {_METADATA_KEY: json.dumps(facts_of(rec)).encode()}
    pq.write_table(pa.table(arrays, metadata=metadata), path)
