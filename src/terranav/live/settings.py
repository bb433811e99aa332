"""What the live engine is told: by which source it reckons, what of the sensors, where it starts, when it doubts."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import DEFAULT_RAW_SIGMA_M, LIMITS
from terranav.experiment.registry import check_name
from terranav.experiment.run import check_seed
from terranav.io.geoid import Given
from terranav.maps.datum import SEA, stated_datum
from terranav.maps.map import Map

#: how the vehicle is reckoned between two fixes -> what the navigator is told of that unless the user says better
GRADES: dict[str, InsGrade] = {
    "velocity": InsGrade(200.0, 1.0, 1.0, 0.05, name="velocity of an autopilot"),
    "position": InsGrade(500.0, 0.5, 1.0, name="free inertial position"),
    "airspeed": InsGrade(200.0, 7.0, 2.0, 0.1, name="airspeed and heading"),
}
#: 1-sigma of the readings; depth as of a single-beam echo sounder in shallow water
SIGMAS: dict[str, float] = {**DEFAULT_RAW_SIGMA_M, "depth_m": 1.0}


@dataclass(frozen=True)
class LiveSettings:
    """Settings of the live engine.

    Attributes
    ----------
    ins_source : str
        'velocity': the autopilot's velocity, summed up from the start; right as soon as the autopilot uses our fixes,
        since its own position is then no inertial one. 'position': the autopilot's position is a free inertial one.
        'airspeed': airspeed and heading, with the wind as told.
    ins : InsGrade, optional
        What the navigator is told of that source; else the one of GRADES.
    start_deg : (lat, lon), optional
        Where reckoning by velocity or airspeed starts; else the first position that the vehicle tells [deg].
    wind_mps : (north, east)
        Where the wind blows to, for 'airspeed' [m/s].
    estimator, estimator_settings, seed
        As `terranav.run` takes them.
    sigma : mapping
        1-sigma of radar_altitude_m, laser_altitude_m, baro_altitude_m, depth_m [m]; else those of SIGMAS.
    alt_datum : str
        What the vehicle's altitudes count from.
    geoid : path, optional
        A geoid grid beside those that are installed.
    system_id : int, optional
        The MAVLink vehicle to hear; else the first that is heard.
    rate_hz : float
        Most epochs [Hz].
    spacing_cells : float
        A reading is used once the vehicle has moved by so much of the finest map's cell since the last that was: closer
        together they see the same ground, while the navigator and its monitor take their errors for independent. 0 uses
        all.
    lag_s : float
        How long a reading may wait for position and attitude of its own time [s].
    max_gap_s : float
        Reckoning by velocity or airspeed breaks when they are silent for longer [s].
    frozen_s : float
        A sensor that repeats one value for so long while the vehicle moves is left out [s].
    silent_s : float
        A link or a sensor that says nothing for longer is remarked on [s].
    sigma_floor_m : float
        No fix claims a smaller 1-sigma than this [m].
    warn_ahead_s : float
        How far ahead the end of the map is looked for [s]; 0 looks for none.
    max_speed_mps : float
        Faster the vehicle cannot be [m/s].
    monitor : bool
        Whether GNSS is watched (`watching`); no fix depends on it.

    Raises
    ------
    ConfigError
        Naming the setting, the value and what was expected.
    """

    ins_source: str = "velocity"
    ins: InsGrade | None = None
    start_deg: tuple[float, float] | None = None
    wind_mps: tuple[float, float] = (0.0, 0.0)
    estimator: str = "marginalized"
    estimator_settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    sigma: Mapping[str, float] = field(default_factory=dict)
    alt_datum: str = SEA
    geoid: Given = None
    system_id: int | None = None
    rate_hz: float = 10.0
    spacing_cells: float = 0.5
    lag_s: float = 0.25
    max_gap_s: float = 3.0
    frozen_s: float = 5.0
    silent_s: float = 2.0
    sigma_floor_m: float = 1.0
    warn_ahead_s: float = 60.0
    max_speed_mps: float = 350.0
    monitor: bool = False

    def __post_init__(self) -> None:
        if self.ins_source not in GRADES:
            unknown_name("ins_source", str(self.ins_source), GRADES)
        if self.ins is not None and not isinstance(self.ins, InsGrade):
            raise ConfigError(f"ins is {self.ins!r}, expected an InsGrade")
        if not isinstance(self.monitor, bool):
            raise ConfigError(f"monitor is {self.monitor!r}, expected True or False")
        check_name(self.estimator)
        check_seed(self.seed)
        for key, value in self.sigma.items():
            if key not in SIGMAS:
                unknown_name("key in sigma", str(key), SIGMAS)
            finite(f"sigma {key}", value, above=0.0)
        _check_place(self.start_deg)
        _pair("wind_mps", self.wind_mps, 150.0)
        stated_datum(self.alt_datum, "alt_datum")
        system = self.system_id
        if system is not None and (isinstance(system, bool) or not isinstance(system, int) or not 1 <= system <= 255):
            raise ConfigError(f"system_id is {system!r}, expected a whole number from 1 to 255")
        for key in ("rate_hz", "max_gap_s", "frozen_s", "silent_s", "sigma_floor_m", "max_speed_mps"):
            finite(key, getattr(self, key), above=0.0)
        finite("rate_hz", self.rate_hz, maximum=100.0)
        finite("lag_s", self.lag_s, minimum=0.0, maximum=2.0)
        finite("spacing_cells", self.spacing_cells, minimum=0.0, maximum=100.0)
        finite("warn_ahead_s", self.warn_ahead_s, minimum=0.0, maximum=3600.0)
        object.__setattr__(self, "estimator_settings", MappingProxyType(dict(self.estimator_settings)))
        object.__setattr__(self, "sigma", MappingProxyType(dict(self.sigma)))

    @property
    def grade(self) -> InsGrade:
        """What the navigator is told of the source."""
        return self.ins if self.ins is not None else GRADES[self.ins_source]

    def sigma_of(self, column: str) -> float:
        """1-sigma of the readings of a column [m]."""
        return float(self.sigma.get(column, SIGMAS[column]))

    def digest(self, maps: Sequence[Map]) -> str:
        """SHA-256 over all that makes a fix: settings and maps, hexadecimal. A checkpoint holds for these alone."""
        told = [(entry.name, _plain(getattr(self, entry.name))) for entry in fields(self)]
        charts = [(chart.checksum, chart.kind, chart.sigma, chart.datum, chart.correlation_m) for chart in maps]
        return hashlib.sha256(repr((told, charts)).encode()).hexdigest()


def _plain(value: Any) -> Any:
    """A setting as text that is the same in every process."""
    text = dict(value) if isinstance(value, Mapping) else value
    return re.sub(r" at 0x[0-9a-f]+", "", repr(text))


def _check_place(place: tuple[float, float] | None) -> None:
    """Raise ConfigError unless a place is none, or latitude and longitude."""
    if place is None:
        return
    lat, lon = _pair("start_deg", place, 360.0)
    for key, value in (("lat_deg", lat), ("lon_deg", lon)):
        low, high = LIMITS[key]
        finite(f"start_deg {key}", value, minimum=low, maximum=high)


def _pair(key: str, value: Any, largest: float) -> tuple[float, float]:
    """Two finite numbers, or ConfigError."""
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ConfigError(f"{key} is {value!r}, expected two numbers")
    first, second = (finite(key, one, minimum=-largest, maximum=largest) for one in value)
    return first, second
