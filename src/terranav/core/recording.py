"""Recording: the epochs of one run as columns, the truth where it is known, and where it all came from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import unknown_name
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


@dataclass(frozen=True)
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

    Raises
    ------
    DataError
        Naming the recording, the column, the row and the value: a missing or unknown column, lengths that differ, zero
        epochs, times that do not increase, a position that is NaN or out of range, a sigma that is not positive.
    """

    columns: Mapping[str, FloatArray]
    ins: InsGrade | None = None
    sigma: Mapping[str, float] = field(default_factory=dict)
    source: Mapping[str, str] = field(default_factory=dict)
    name: str = "recording"

    def __post_init__(self) -> None:
        columns = {key: np.array(value, dtype=np.float64) for key, value in self.columns.items()}
        _check(self.name, columns, self.sigma)
        for array in columns.values():
            array.flags.writeable = False
        ordered = {key: columns[key] for key in COLUMNS if key in columns}
        object.__setattr__(self, "columns", MappingProxyType(ordered))
        object.__setattr__(self, "sigma", MappingProxyType(dict(self.sigma)))
        object.__setattr__(self, "source", MappingProxyType(dict(self.source)))

    def __reduce__(self) -> tuple[Any, ...]:
        return (Recording, (dict(self.columns), self.ins, dict(self.sigma), dict(self.source), self.name))

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

    def between(self, start_s: float, end_s: float) -> Recording:
        """The epochs with start_s <= time <= end_s; DataError when there are none."""
        inside = (self.time_s >= start_s) & (self.time_s <= end_s)
        return replace(self, columns={key: value[inside] for key, value in self.columns.items()})

    def with_columns(self, **columns: FloatArray) -> Recording:
        """The same recording with some columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})

    def _triples(self, names: tuple[str, str, str]) -> list[tuple[float, float, float] | None]:
        """Per epoch the three values, or None where one is missing."""
        if not all(name in self.columns for name in names):
            return [None] * len(self)
        rows = np.stack([self.columns[name] for name in names], axis=1)
        known = np.isfinite(rows).all(axis=1)
        return [(r[0], r[1], r[2]) if ok else None for r, ok in zip(rows.tolist(), known, strict=True)]


def _check(name: str, columns: dict[str, FloatArray], sigma: Mapping[str, float]) -> None:
    """Raise DataError for anything that a recording must not be."""
    for key in columns:
        if key not in COLUMNS:
            try:
                unknown_name("column", key, COLUMNS)
            except ValueError as error:
                raise DataError(f"{name}: {error}") from None
    for key in REQUIRED:
        if key not in columns:
            raise DataError(f"{name}: column {key} is missing; a recording needs {', '.join(REQUIRED)}")
    n = columns["time_s"].size
    for key, array in columns.items():
        if array.ndim != 1 or array.size != n:
            raise DataError(f"{name}: column {key} has shape {array.shape}, expected ({n},) like time_s")
    if n == 0:
        raise DataError(f"{name}: zero epochs, expected at least one row")
    for key in REQUIRED:
        bad = np.flatnonzero(~np.isfinite(columns[key]))
        if bad.size:
            raise DataError(f"{name}: {key} in row {bad[0] + 1} is {columns[key][bad[0]]}, expected a finite number")
    steps = np.flatnonzero(np.diff(columns["time_s"]) <= 0)
    if steps.size:
        i = int(steps[0])
        before, after = columns["time_s"][i], columns["time_s"][i + 1]
        raise DataError(f"{name}: time_s in row {i + 2} is {after!r} after {before!r}, expected increasing times")
    limits = {**LIMITS, **{kind.sigma_column: (np.nextafter(0.0, 1.0), np.inf) for kind in KINDS.values()}}
    for key, (low, high) in limits.items():
        if key in columns:
            bad = np.flatnonzero((columns[key] < low) | (columns[key] > high))
            if bad.size:
                wanted = "a positive number" if "sigma" in key else f"a value in [{low:g}, {high:g}]"
                raise DataError(f"{name}: {key} in row {bad[0] + 1} is {columns[key][bad[0]]:g}, expected {wanted}")
    for key, value in sigma.items():
        if key not in READY and key not in RAW:
            try:
                unknown_name("key in [sigma]", key, (*READY, *RAW))
            except ValueError as error:
                raise DataError(f"{name}: {error}") from None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
            raise DataError(f"{name}: [sigma] {key} is {value!r}, expected a positive number")
