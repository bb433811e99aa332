"""Recording: the epochs of one run as columns, the truth where it is known, and where it all came from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import nearest_name
from terranav.core.earth import offset_m
from terranav.core.errors import DataError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.records import Epoch, Measurement

FloatArray = NDArray[np.float64]

REQUIRED = ("time_s", "lat_deg", "lon_deg", "alt_m")
VELOCITY = ("vn_mps", "ve_mps", "vd_mps")
ATTITUDE = ("roll_deg", "pitch_deg", "heading_deg")
TRUTH = ("true_lat_deg", "true_lon_deg", "true_alt_m")
#: raw reading column -> the kind of Measurement it becomes
RAW = {
    "radar_altitude_m": "radar_altitude",
    "laser_altitude_m": "laser_altitude",
    "baro_altitude_m": "baro_altitude",
}
#: ready measurement column -> its Kind
READY = {kind.column: kind for kind in KINDS.values()}
#: what a recording can name the vertical datum of: 'all' is every height that is not named itself
HEIGHTS = ("all", "alt_m", "true_alt_m", "baro_altitude_m", "terrain_m", "depth_m")
#: 1-sigma [m] assumed for a raw reading when the recording states none
DEFAULT_RAW_SIGMA_M = {"radar_altitude_m": 3.0, "laser_altitude_m": 1.0, "baro_altitude_m": 5.0}

COLUMNS: tuple[str, ...] = (
    *REQUIRED,
    *VELOCITY,
    *ATTITUDE,
    *TRUTH,
    *[name for kind in KINDS.values() for name in (kind.column, kind.sigma_column)],
    *RAW,
)
LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("lat_deg", "true_lat_deg"), (-90.0, 90.0)),
    **dict.fromkeys(("lon_deg", "true_lon_deg"), (-180.0, 360.0)),
    **dict.fromkeys(("alt_m", "true_alt_m"), (-12000.0, 100000.0)),
}


@dataclass(frozen=True, eq=False)
class Recording:
    """The epochs of one run.

    Attributes
    ----------
    columns : mapping of column name to float64 array (n,)
        Names and units as in COLUMNS; NaN is 'no reading'. The arrays are read-only.
    ins : InsGrade or None
        What is known of the INS that made the indicated positions.
    sigma : mapping
        1-sigma per reading column [its unit], used where no ..._sigma_... column has a value.
    source : mapping
        Who measured, licence, how it was made; free text.
    name : str
        Of the file or the scenario, for messages and reports.
    datum : mapping
        What the heights count from, in the words of `terranav.maps.datum`: under 'all' for all of them, under
        'alt_m', 'true_alt_m', 'baro_altitude_m', 'terrain_m', 'depth_m' for those that differ. Empty is unknown.

    Raises
    ------
    DataError
        Naming the recording, the column, the row (from 1) and the value: a missing or unknown column, lengths that
        differ, zero epochs, times that do not increase, a position that is NaN or out of range, an infinite value, a
        sigma that is not positive, a source that is not text, a datum of no height.
    """

    columns: Mapping[str, FloatArray]
    ins: InsGrade | None = None
    sigma: Mapping[str, float] = field(default_factory=dict)
    source: Mapping[str, str] = field(default_factory=dict)
    name: str = "recording"
    datum: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        columns = {key: np.array(value, dtype=np.float64) for key, value in self.columns.items()}
        _check_shape(self.name, columns)
        _check_values(self.name, columns)
        _check_facts(self.name, self.sigma, self.source)
        _check_datum(self.name, self.datum)
        for array in columns.values():
            array.flags.writeable = False
        ordered = {key: columns[key] for key in COLUMNS if key in columns}
        object.__setattr__(self, "columns", MappingProxyType(ordered))
        object.__setattr__(self, "sigma", MappingProxyType({key: float(value) for key, value in self.sigma.items()}))
        object.__setattr__(self, "source", MappingProxyType(dict(self.source)))
        object.__setattr__(self, "datum", MappingProxyType(dict(self.datum)))

    def __reduce__(self) -> tuple[Any, ...]:
        facts = (dict(self.sigma), dict(self.source), self.name, dict(self.datum))
        return (Recording, (dict(self.columns), self.ins, *facts))

    def __repr__(self) -> str:
        told = [f"{key} {np.count_nonzero(np.isfinite(self.columns[key]))}" for key in self.readings] or ["no readings"]
        known = [word for word, there in (("truth", self.has_truth), ("ins", self.ins is not None)) if there]
        duration_s = self.time_s[-1] - self.time_s[0]
        return f"Recording({self.name!r}: {', '.join([f'{len(self)} epochs in {duration_s:.1f} s', *told, *known])})"

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def time_s(self) -> FloatArray:
        """(n,) times, strictly increasing [s]."""
        return self.columns["time_s"]

    @property
    def lat_deg(self) -> FloatArray:
        """(n,) indicated latitude [deg]."""
        return self.columns["lat_deg"]

    @property
    def lon_deg(self) -> FloatArray:
        """(n,) indicated longitude [deg]."""
        return self.columns["lon_deg"]

    @property
    def alt_m(self) -> FloatArray:
        """(n,) indicated altitude [m]."""
        return self.columns["alt_m"]

    @property
    def has_truth(self) -> bool:
        """Whether the true horizontal position is known at any epoch."""
        return all(key in self.columns and bool(np.isfinite(self.columns[key]).any()) for key in TRUTH[:2])

    @property
    def readings(self) -> tuple[str, ...]:
        """Columns of measurements and raw readings that hold at least one value."""
        return tuple(key for key in (*READY, *RAW) if key in self.columns and np.isfinite(self.columns[key]).any())

    def ins_error_m(self) -> FloatArray:
        """(n, 2) indicated minus true position, north and east [m]; StateError without truth."""
        if not self.has_truth:
            raise StateError(f"{self.name}: the INS error needs the columns true_lat_deg and true_lon_deg")
        true_lat, true_lon = self.columns["true_lat_deg"], self.columns["true_lon_deg"]
        return np.stack(offset_m(true_lat, true_lon, self.lat_deg, self.lon_deg), axis=1)

    def epochs(self) -> Iterator[Epoch]:
        """The stream that estimators see: everything but the truth, in the order of time."""
        velocity = self._triples(VELOCITY)
        attitude = self._triples(ATTITUDE)
        readings: list[list[Measurement]] = [[] for _ in range(len(self))]
        for key in self.readings:
            values, sigmas = self.columns[key], self.sigma_of(key)
            kind, sign = (READY[key].name, READY[key].sign) if key in READY else (RAW[key], 1)
            for i in np.flatnonzero(np.isfinite(values)).tolist():
                readings[i].append(Measurement(kind, sign * float(values[i]), float(sigmas[i])))
        positions = zip(
            self.time_s.tolist(),
            self.lat_deg.tolist(),
            self.lon_deg.tolist(),
            self.alt_m.tolist(),
            strict=True,
        )
        for i, (time_s, lat_deg, lon_deg, alt_m) in enumerate(positions):
            yield Epoch(time_s, lat_deg, lon_deg, alt_m, velocity[i], attitude[i], tuple(readings[i]))

    def sigma_of(self, column: str) -> FloatArray:
        """(n,) 1-sigma of one reading column: its sigma column, else the recording's constant, else a default."""
        if column in READY:
            default = READY[column].default_sigma
            own = self.columns.get(READY[column].sigma_column)
        else:
            default, own = DEFAULT_RAW_SIGMA_M[column], None
        constant = np.full(len(self), float(self.sigma.get(column, default)))
        return constant if own is None else np.where(np.isfinite(own), own, constant)

    def datum_of(self, column: str) -> str | None:
        """What the heights of a column count from, in the recording's words; None where it does not say."""
        return self.datum.get(column, self.datum.get("all"))

    def between(self, start_s: float, end_s: float) -> Recording:
        """The epochs with start_s <= time <= end_s; DataError when there are none."""
        inside = (self.time_s >= start_s) & (self.time_s <= end_s)
        if not inside.any():
            span = f"a time within [{self.time_s[0]:g}, {self.time_s[-1]:g}]"
            raise DataError(f"{self.name}: no epoch has time_s in [{start_s:g}, {end_s:g}], expected {span}")
        return replace(self, columns={key: value[inside] for key, value in self.columns.items()})

    def with_columns(self, **columns: FloatArray) -> Recording:
        """The same recording with some columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})

    def _triples(self, names: tuple[str, str, str]) -> list[tuple[float, float, float] | None]:
        """Per epoch the three values, or None where one is missing."""
        if not all(name in self.columns for name in names):
            return [None] * len(self)
        rows = np.stack([self.columns[name] for name in names], axis=1)
        return [(r[0], r[1], r[2]) if all(map(math.isfinite, r)) else None for r in rows.tolist()]


def _check_shape(name: str, columns: Mapping[str, FloatArray]) -> None:
    """Raise DataError unless the columns are known, complete and of one length."""
    for key in columns:
        if key not in COLUMNS:
            raise DataError(f"{name}: unknown column {key!r}{nearest_name(key, COLUMNS)}; known: {', '.join(COLUMNS)}")
    for key in REQUIRED:
        if key not in columns:
            raise DataError(f"{name}: column {key} is missing; a recording needs {', '.join(REQUIRED)}")
    n = columns["time_s"].size
    for key, array in columns.items():
        if array.shape != (n,):
            raise DataError(f"{name}: column {key} has shape {array.shape}, expected ({n},) like time_s")
    if n == 0:
        raise DataError(f"{name}: zero epochs, expected at least one row")


def _check_values(name: str, columns: Mapping[str, FloatArray]) -> None:
    """Raise DataError for the first value that cannot be, naming its row."""
    sigmas = {kind.sigma_column for kind in KINDS.values()}
    for key, array in columns.items():
        if key in REQUIRED:
            _refuse(name, key, array, ~np.isfinite(array), "a finite number")
        _refuse(name, key, array, np.isinf(array), "a finite number, or none where there is no reading")
        if key in sigmas:
            _refuse(name, key, array, array <= 0.0, "a positive number")
        if key in LIMITS:
            low, high = LIMITS[key]
            _refuse(name, key, array, (array < low) | (array > high), f"a value in [{low:g}, {high:g}]")
    time_s = columns["time_s"]
    steps = np.flatnonzero(np.diff(time_s) <= 0)
    if steps.size:
        before, after = time_s[steps[0] : steps[0] + 2].tolist()
        raise DataError(
            f"{name}: time_s in row {steps[0] + 2} is {after!r} after {before!r}, expected increasing times"
        )


def _refuse(name: str, key: str, array: FloatArray, bad: NDArray[np.bool_], expected: str) -> None:
    """Raise DataError for the first row where `bad` is true."""
    rows = np.flatnonzero(bad)
    if rows.size:
        raise DataError(f"{name}: {key} in row {rows[0] + 1} is {array[rows[0]]:.10g}, expected {expected}")


def _check_facts(name: str, sigma: Mapping[str, float], source: Mapping[str, str]) -> None:
    """Raise DataError for a sigma of no reading or that is not positive, and for a source that is not text."""
    known = (*READY, *RAW)
    for key, value in sigma.items():
        if key not in known:
            raise DataError(
                f"{name}: unknown key {key!r} in [sigma]{nearest_name(key, known)}; known: {', '.join(known)}"
            )
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
            raise DataError(f"{name}: [sigma] {key} is {value!r}, expected a positive number")
    for key, text in source.items():
        if not isinstance(key, str) or not isinstance(text, str):
            raise DataError(f"{name}: [source] {key} is {text!r}, expected a text")


def _check_datum(name: str, datum: Mapping[str, str]) -> None:
    """Raise DataError for a datum of no height, or that is not text."""
    for key, text in datum.items():
        if key not in HEIGHTS:
            near = nearest_name(key, HEIGHTS)
            raise DataError(f"{name}: unknown key {key!r} in [vertical_datum]{near}; known: {', '.join(HEIGHTS)}")
        if not isinstance(text, str):
            raise DataError(f"{name}: [vertical_datum] {key} is {text!r}, expected a text such as 'EGM96'")
