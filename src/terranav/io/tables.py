r"""Any table of a survey, a cruise or a log, made a recording by a short TOML file that says what its columns are.

The columns file, key by key (everything is optional unless it says otherwise)::

    name = "flight 3"              # of the recording; the table's file name unless given
    position_is_true = true        # the position is GNSS: it also fills true_lat_deg, true_lon_deg and true_alt_m.
                                   # "horizontal": the altitude is not true. Add an INS with terranav.add_drift
    [table]                        # how the text is a table
    delimiter = ","                # one character (a tab is "\t"), "whitespace", or "fixed" with widths
    widths = [10, 11, 11]          # characters per column, for "fixed"
    names = ["Line", "Lat"]        # where there is no header row: the columns from the left; others stay nameless
    skip_lines = 2                 # lines before the header (or the first row)
    comment = "#"                  # the rest of a line after it is not read
    null = [-9999.99, "*"]         # 'no reading', beside the empty cell: numbers by value, texts as they stand
    decimal_comma = true
    encoding = "utf-8-sig"         # as Python names it

    [time]                         # required, with column, columns or rate_hz
    column = "UTC"
    columns = ["Date", "Time"]     # or several, joined by a blank
    format = "iso"                 # "iso" (with or without zone); a strptime pattern such as "%Y/%m/%d %H:%M:%S";
                                   # "unix" (since 1970 UTC); "seconds" (since `zero`, or since any start)
    unit = "s"                     # of "unix" and "seconds": s, ms, us, ns, min, h, day
    zone = "+01:00"                # offset from UTC of texts that carry none; UTC unless given
    zero = "2021-01-20T00:00:00Z"  # what "seconds", rate_hz and patterns without a date count from
    rollover = true                # a count that falls back by more than half a day has passed midnight
    rate_hz = 4.0                  # no time column at all: rows of the file at this rate

    [columns]                      # recording column = what it is made of; required: lat_deg, lon_deg and alt_m
    lat_deg = "Lat"                # a column in the recording's unit
    alt_m = {column = "ALT", unit = "ft", scale = 1.0, offset = -2.5, null = [0]}  # scale * (ALT to m) + offset [m]
    terrain_m = {subtract = ["Alt", "Height"]}  # the first minus the second; both may be tables as above
    alt_m = {value = 0.0}          # the same in every row

    [position]                     # instead of lat_deg and lon_deg: coordinates of any CRS that pyproj knows
    crs = "EPSG:3071"
    easting = "E"                  # its first axis in the order east, north (a geographic CRS: longitude); as [columns]
    northing = "N"

    [rows]
    where = {Line = 100101}        # keep rows whose column has this value, or one of a list
    on_bad_fix = "error"           # "drop": leave out rows without time or position, or off the globe
    on_unsorted = "error"          # "sort": put the rows into the order of time
    on_duplicate_time = "error"    # "drop": keep the first row of each time
    max_speed_mps = 10.0           # leave out positions (or times) that no vehicle of this speed can have: what stays
                                   # is the longest chain of rows in which each can be reached from the one before

    [ins]                          # what was known of the INS: the keys of InsGrade
    [sigma]                        # 1-sigma per reading column: terrain_m = 2.0
    [vertical_datum]               # what heights count from: all = "EGM96", alt_m = "ellipsoid", ...
    [source]                       # texts: who measured, licence

Units: m km cm mm ft us_ft fathom nmi; deg rad arcmin arcsec grad; m/s cm/s km/h kn ft/s ft/min; mGal uGal Gal um/s2
m/s2; nT uT mG G T.

time_s counts from the first row kept. [source] gains `table` (file name), `start_utc` (ISO time of that row, where it
is known) and `rows` (how many were kept, and why others were not).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.core.recording import COLUMNS, READY, REQUIRED, TRUTH, FloatArray, Recording
from terranav.io.sidecar import about_from
from terranav.io.table_columns import column_values, position_values
from terranav.io.table_rows import kept_rows, policy_from
from terranav.io.table_time import times_of
from terranav.io.text_table import Layout, TextTable, is_number, read_text_table, to_float
from terranav.io.toml_table import TomlTable, read_toml

_WHAT = "a table as text (CSV or the like)"


def convert_table(table_path: str | Path, columns_toml_path: str | Path) -> Recording:
    """Make a recording of any delimited table.

    Parameters
    ----------
    table_path : str or Path
        The table.
    columns_toml_path : str or Path
        What its columns are; see the head of this module for the keys.

    Returns
    -------
    Recording

    Raises
    ------
    ConfigError
        For a key or a value of the columns file, offering the nearest key there is.
    DataError
        For the table: a column that is not there (offering the nearest), a cell that is no number, rows that the
        policies of [rows] do not let pass.

    Warns
    -----
    DataWarning
        For readings that occur nowhere on Earth: a unit or a sign must be wrong.
    """
    spec = read_toml(columns_toml_path, "a columns file (.toml)", ConfigError)
    about = about_from(spec)
    truth = _truth_wanted(spec)
    table = read_text_table(table_path, _WHAT, _layout(spec.table("table")))
    rows = spec.table("rows") or spec.inner({}, "[rows]")
    selected = _where(table, rows.table("where"))
    columns, zero = _read_columns(selected, spec)
    policy = policy_from(rows)
    rows.close()
    spec.close()
    kept, story = kept_rows(selected, columns, policy)
    columns = {key: values[kept] for key, values in columns.items()}
    start_s = float(columns["time_s"][0])
    columns["time_s"] = columns["time_s"] - start_s
    for key in truth:
        columns.setdefault(key, columns[key.removeprefix("true_")])
    source = {**about.source, "table": Path(table_path).name, "rows": f"{kept.size} of {len(table)} kept{story}"}
    if zero is not None:
        source["start_utc"] = (zero + timedelta(seconds=start_s)).isoformat().replace("+00:00", "Z")
    name = Path(table_path).stem if about.name is None else about.name
    for doubt in _doubts(columns):
        warnings.warn(f"{table_path}: {doubt}", DataWarning, stacklevel=2)
    try:
        return Recording(columns, about.ins, about.sigma, source, name, about.datum)
    except DataError as problem:
        raise DataError(f"{table_path}: {str(problem).removeprefix(f'{name}: ')} (rows counted after [rows])") from None


def _doubts(columns: Mapping[str, FloatArray]) -> Iterator[str]:
    """What to warn of: readings that occur nowhere on Earth."""
    for key, kind in READY.items():
        values = kind.sign * columns[key][np.isfinite(columns[key])] if key in columns else np.empty(0)
        low, high = kind.plausible
        if values.size and (values.min() < low or values.max() > high):
            seen = f"{key} runs from {values.min():g} to {values.max():g} {kind.unit} as map values"
            yield f"{seen}, expected within [{low:g}, {high:g}]: is its unit or sign right?"


def _layout(spec: TomlTable | None) -> Layout:
    """[table]."""
    if spec is None:
        return Layout()
    delimiter = spec.text("delimiter") or ","
    if len(delimiter) != 1 and delimiter not in ("whitespace", "fixed"):
        spec.fail("delimiter", "one character, 'whitespace' or 'fixed'")
    widths, names = spec.value("widths"), spec.texts("names")
    if (delimiter == "fixed") != (widths is not None):
        spec.missing("widths", "widths together with delimiter = 'fixed', and only there")
    if widths is not None and not (isinstance(widths, list) and all(type(w) is int and w > 0 for w in widths)):
        spec.fail("widths", "a list of positive whole numbers such as [10, 8, 8]")
    layout = Layout(
        delimiter=delimiter,
        widths=tuple(widths or ()),
        names=None if names is None else tuple(names),
        skip_lines=spec.count("skip_lines", 0),
        comment=spec.text("comment") or "",
        null=tuple(spec.nulls("null")),
        decimal_comma=spec.flag("decimal_comma", False),
        encoding=spec.text("encoding") or "utf-8-sig",
    )
    try:
        "".encode(layout.encoding)
    except LookupError:
        spec.fail("encoding", "an encoding that Python knows, such as 'utf-8' or 'latin-1'")
    spec.close()
    return layout


def _truth_wanted(spec: TomlTable) -> tuple[str, ...]:
    """The truth columns that position_is_true fills."""
    value = spec.value("position_is_true")
    if value not in (None, True, False, "horizontal"):
        spec.fail("position_is_true", "true, false or 'horizontal'")
    return TRUTH[:2] if value == "horizontal" else TRUTH if value else ()


def _where(table: TextTable, spec: TomlTable | None) -> TextTable:
    """The rows that [rows] where asks for."""
    if spec is None:
        return table
    for key in spec.given():
        value = spec.value(key)
        wanted = value if isinstance(value, list) else [value]
        if not wanted or not all(isinstance(item, (str, int, float)) and not isinstance(item, bool) for item in wanted):
            spec.fail(key, "a number, a text, or a list of them")
        texts = table.texts(key)
        numbers = {float(item) for item in wanted if not isinstance(item, str)}
        keep = np.array([t in wanted or (bool(numbers) and is_number(t) and to_float(t) in numbers) for t in texts])
        if not keep.any():
            seen = ", ".join(list(dict.fromkeys(texts))[:5])
            raise DataError(f"{table.path}: no row has {key} = {value!r}, expected a value that occurs ({seen}, ...)")
        table = table.select(keep)
    return table


def _read_columns(table: TextTable, spec: TomlTable) -> tuple[dict[str, FloatArray], datetime | None]:
    """Every recording column of the selected rows, and the instant from which time_s counts."""
    if len(table) == 0:
        raise DataError(f"{table.path}: the table has a header but no rows, expected at least one")
    time_spec, columns_spec, position_spec = spec.table("time"), spec.table("columns"), spec.table("position")
    if time_spec is None:
        spec.missing("[time]", 'a table such as {column = "UTC", format = "iso"}')
    if columns_spec is None:
        spec.missing("[columns]", 'a table of recording columns such as lat_deg = "Lat"')
    seconds, zero = times_of(table, time_spec)
    time_spec.close()
    known = [key for key in COLUMNS if key != "time_s"]
    columns = {"time_s": seconds}
    if position_spec is not None:
        columns["lat_deg"], columns["lon_deg"] = position_values(table, position_spec)
        known = [key for key in known if key not in ("lat_deg", "lon_deg")]
    for key in columns_spec.given():
        if key not in known:
            columns_spec.unknown(key, known)
        columns[key] = column_values(table, columns_spec, key)
    for key in REQUIRED:
        if key not in columns:
            example = "{value = 0.0}" if key == "alt_m" else '"Lat"'
            columns_spec.missing(key, f"what it is made of, such as {key} = {example}")
    return columns, zero
