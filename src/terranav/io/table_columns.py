"""What a recording column is made of: source columns with units and nulls, differences, constants, coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np

from terranav.core.recording import FloatArray
from terranav.io.table_units import units_of
from terranav.io.text_table import TextTable
from terranav.io.toml_table import TomlTable

_EXPECTED = 'a column name, {column = "ALT", unit = "ft"}, {subtract = ["Alt", "Height"]} or {value = 0.0}'


def column_values(table: TextTable, spec: TomlTable, key: str) -> FloatArray:
    """Values of the recording column `key` as [columns] says [the column's unit], NaN where there is no reading."""
    return _values(table, spec, key, units_of(key), None)


def position_values(table: TextTable, spec: TomlTable) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude [deg] from the coordinates that [position] names, NaN where there are none."""
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    crs = spec.text("crs", "a CRS such as 'EPSG:3071'")
    for key in ("crs", "easting", "northing"):
        if key not in spec:
            spec.missing(key, "crs, easting and northing together")
    try:
        transformer = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    except CRSError:
        spec.fail("crs", "a CRS that pyproj knows, such as 'EPSG:3071'")
    raw: dict[str, float] = {"unit of the CRS": 1.0}  # units are the CRS's business
    east, north = (_values(table, spec, key, raw, None) for key in ("easting", "northing"))
    spec.close()
    lon, lat = transformer.transform(east, north)
    off = ~(np.isfinite(lon) & np.isfinite(lat))
    return np.where(off, np.nan, lat), np.where(off, np.nan, lon)


def _values(table: TextTable, spec: TomlTable, key: str, units: dict[str, float], unit: str | None) -> FloatArray:
    """Values of one entry; `unit` is the one that an enclosing difference has given."""
    entry: Any = spec.value(key)
    if isinstance(entry, str):
        return _scaled(table.numbers(entry), 1.0 if unit is None else units[unit])
    if not isinstance(entry, dict):
        spec.fail(key, _EXPECTED)
    own = spec.inner(entry, f"{spec.label} {key}")
    if sum(name in own for name in ("column", "subtract", "value")) != 1:
        spec.fail(key, _EXPECTED)
    if "value" in own:
        constant = np.full(len(table), own.number("value", 0.0))
        own.close()
        return constant
    chosen = own.choice("unit", units, unit or next(iter(units)))
    scale, offset = own.number("scale", 1.0), own.number("offset", 0.0)
    if "column" in own:
        null = own.nulls("null")
        raw = table.numbers(own.text("column", "the name of a column") or "", null)
        values = _scaled(raw, units[chosen])
    else:
        values = _difference(table, own, units, chosen)
    own.close()
    return _scaled(values, scale) if offset == 0.0 else _scaled(values, scale) + offset


def _difference(table: TextTable, spec: TomlTable, units: dict[str, float], unit: str) -> FloatArray:
    """The first minus the second of `subtract`, each in its own unit or else in `unit`."""
    pair = spec.value("subtract")
    if not isinstance(pair, list) or len(pair) != 2:
        spec.fail("subtract", 'two columns such as ["Alt", "Height"]')
    terms = spec.inner({"first": pair[0], "second": pair[1]}, f"{spec.label} subtract")
    return _values(table, terms, "first", units, unit) - _values(table, terms, "second", units, unit)


def _scaled(values: FloatArray, factor: float) -> FloatArray:
    """Values times a factor; untouched where it is one."""
    return values if factor == 1.0 else values * factor
