"""What the study `monitor` flies: an hour over one ground with an INS, and GNSS that is honest or not.

The vehicle wanders about the middle of a map at a constant speed, from one random place to the next in turns of at most
TURN_DEG_PER_S; an epoch each second, a reading of the altimeter every READING_EPOCHS. Readings and INS are those of
`world.flown`. INS and estimator know nothing of GNSS, so one flight serves for every way in which GNSS can be false.

Errors of an honest GNSS: per axis a first-order Markov process of GNSS_SIGMA_M and GNSS_MEMORY_S, and white noise.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, shift
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.experiment.studies.sources import MapSource
from terranav.experiment.studies.tracks import MATCHED, Leg, Track
from terranav.experiment.studies.world import flown
from terranav.ins.drift import add_drift
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

HOUR_S, SPEED_MPS, TURN_DEG_PER_S = 3600.0, (40.0, 80.0), 1.5
READING_EPOCHS = 2
CELLS, CELL_M, MAP_SIGMA_M = 512, 60.0, 3.0
EDGE_M = 4000.0  # the vehicle keeps so far from the edge of the map
NEAR_M = 1500.0  # so near a place it turns to the next
GNSS_SIGMA_M, GNSS_MEMORY_S, GNSS_WHITE_M, TOLD_SIGMA_M = 2.0, 60.0, 0.5, 3.0
#: synthetic ground -> standard deviation and correlation length [m]
SYNTHETIC = {"rough": (60.0, 500.0), "middling": (20.0, 1000.0), "flat": (0.3, 2000.0)}


@dataclass(frozen=True)
class Synthetic(MapSource):
    """A Gaussian field of one roughness."""

    ground: str = "rough"

    @property
    def name(self) -> str:
        """'synthetic rough'."""
        return f"synthetic {self.ground}"

    def open(self) -> Map:
        """The map, made once in each process."""
        return _field(self.ground)


@dataclass(frozen=True)
class Box(MapSource):
    """The flattest square of a map, or the roughest: that of the least, or largest, mean slope.

    Attributes
    ----------
    side_m : float
    flattest : bool
    """

    side_m: float = 30_000.0
    flattest: bool = True

    @property
    def name(self) -> str:
        """'N48E010, flattest 30 km'."""
        which = "flattest" if self.flattest else "roughest"
        return f"{super().name}, {which} {self.side_m / 1000.0:.0f} km"

    def open(self) -> Map:
        """The square."""
        return _square(self)


@lru_cache(maxsize=4)
def _field(ground: str) -> Map:
    std, length_m = SYNTHETIC[ground]
    rng = np.random.default_rng(zlib.crc32(ground.encode()))
    return gaussian_map(rng, std=std, correlation_m=length_m, cells=CELLS, cell_m=CELL_M, sigma=MAP_SIGMA_M)


@lru_cache(maxsize=4)
def _square(box: Box) -> Map:
    """Squares are tried in steps of a quarter of their side; one with a void is none."""
    whole = MapSource(box.path, box.options).open()
    south, west, north, east = whole.bounds_deg
    per_lat, per_lon = (float(one) for one in metres_per_degree(0.5 * (south + north)))
    high, wide = box.side_m / per_lat, box.side_m / per_lon
    best, found = math.inf, None
    for low in np.arange(south, north - high, 0.25 * high):
        for left in np.arange(west, east - wide, 0.25 * wide):
            part = whole.crop(low, left, low + high, left + wide)
            steep = float(np.mean(np.hypot(*np.gradient(part.values.astype(np.float64)))))
            steep = steep if box.flattest else -steep
            if steep < best:
                best, found = steep, part
    assert found is not None
    return found


@dataclass(frozen=True)
class Wander(Leg):
    """A way from place to place inside a box about a centre.

    Attributes
    ----------
    half_m : (north, east)
        Half the sides of the box [m].
    seed : int
        Of the places.
    """

    half_m: tuple[float, float] = (10_000.0, 10_000.0)
    seed: int = 0

    def positions_deg(self) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (n,) [deg]."""
        rng, box = np.random.default_rng(self.seed), np.array(self.half_m)
        place, course = rng.uniform(-1.0, 1.0, 2) * box, math.radians(self.heading_deg)
        aim, most = rng.uniform(-1.0, 1.0, 2) * box, math.radians(TURN_DEG_PER_S) * self.interval_s
        found = np.empty((len(self.time_s), 2))
        for i in range(len(found)):
            found[i] = place
            if math.dist(place, aim) < NEAR_M:
                aim = rng.uniform(-1.0, 1.0, 2) * box
            wanted = math.atan2(aim[1] - place[1], aim[0] - place[0])
            turn = (wanted - course + math.pi) % (2.0 * math.pi) - math.pi
            course += min(max(turn, -most), most)
            place = place + self.speed_mps * self.interval_s * np.array((math.cos(course), math.sin(course)))
        return shift(self.lat_deg, self.lon_deg, *found.T)


def wandering(source: MapSource, rng: Generator, duration_s: float = HOUR_S) -> Track:
    """A way over a map."""
    chart = source.open()
    south, west, north, east = chart.bounds_deg
    per_lat, per_lon = (float(one) for one in metres_per_degree(0.5 * (south + north)))
    half = (0.5 * (north - south) * per_lat - EDGE_M, 0.5 * (east - west) * per_lon - EDGE_M)
    heading, speed, seed = rng.uniform(0.0, 360.0), rng.uniform(*SPEED_MPS), int(rng.integers(2**31))
    centre = 0.5 * (south + north), 0.5 * (west + east)
    return Track(source.name, source, Wander(*centre, heading, 0.0, speed, duration_s, 1.0, half, seed))


def recorded(track: Track, told: InsGrade, factor: float, rng: Generator) -> Recording:
    """One flight of a track whose INS is told to be of a grade and is so many times worse."""
    rec = flown(track, MATCHED, rng).rec
    north, east = (rec.columns[key] for key in ("true_lat_deg", "true_lon_deg"))
    per_lat, per_lon = metres_per_degree(north)
    time_s = rec.time_s
    velocity = {"vn_mps": np.gradient(north, time_s) * per_lat, "ve_mps": np.gradient(east, time_s) * per_lon}
    readings = np.where(np.arange(len(rec)) % READING_EPOCHS == 0, rec.columns["terrain_m"], np.nan)
    velocity["terrain_m"] = readings
    true = Recording(
        {**rec.columns, **velocity, "vd_mps": np.zeros(len(rec)), "lat_deg": north, "lon_deg": east},
        sigma=rec.sigma,
        name=track.name,
    )
    return replace(add_drift(true, worse(told, factor), rng), ins=told)


def worse(ins: InsGrade, factor: float) -> InsGrade:
    """A grade with every sigma and walk so many times larger."""
    values: Mapping[str, Any] = {key: value for key, value in vars(ins).items() if key != "name"}
    return InsGrade(**{key: factor * value for key, value in values.items()})


def gnss_error_m(time_s: FloatArray, rng: Generator) -> FloatArray:
    """(n, 2) errors of an honest GNSS [m]."""
    n = len(time_s)
    steps, error = rng.standard_normal((n, 2)), np.empty((n, 2))
    kept = np.exp(-np.diff(time_s, prepend=time_s[0]) / GNSS_MEMORY_S)
    error[0] = steps[0]
    for i in range(1, n):
        error[i] = kept[i] * error[i - 1] + math.sqrt(1.0 - kept[i] ** 2) * steps[i]
    return GNSS_SIGMA_M * error + rng.normal(0.0, GNSS_WHITE_M, (n, 2))


@dataclass(frozen=True)
class Attack:
    """A way in which GNSS is false.

    Attributes
    ----------
    name : str
    speed_mps : float
        It is pulled away at this speed.
    jump_m : float
        After a jump of so much.
    late_s : float
        It says where the vehicle was so long ago.
    frozen : bool
        It stays where it was.
    absent : bool
        It says nothing.
    """

    name: str
    speed_mps: float = 0.0
    jump_m: float = 0.0
    late_s: float = 0.0
    frozen: bool = False
    absent: bool = False

    def positions(
        self, time_s: FloatArray, lat_deg: FloatArray, lon_deg: FloatArray, rows: slice, towards_rad: float
    ) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude of GNSS at some rows of a flight, from the first of which on it is false [deg].

        Parameters
        ----------
        time_s, lat_deg, lon_deg : (n,)
            The whole flight, as an honest GNSS says [s], [deg].
        rows : slice
        towards_rad : float
            Direction of the pull, from north.
        """
        lat, lon, elapsed = lat_deg[rows], lon_deg[rows], time_s[rows] - time_s[rows.start]
        if self.absent:
            return np.full_like(lat, np.nan), np.full_like(lon, np.nan)
        if self.frozen:
            return np.full_like(lat, lat[0]), np.full_like(lon, lon[0])
        if self.late_s:
            then = time_s[rows] - self.late_s
            return np.interp(then, time_s, lat_deg), np.interp(then, time_s, np.unwrap(lon_deg, period=360.0))
        away = self.jump_m + self.speed_mps * elapsed
        return shift(lat, lon, away * math.cos(towards_rad), away * math.sin(towards_rad))


PULLS = tuple(Attack(f"{speed:g} m/s", speed_mps=speed) for speed in (0.5, 1.0, 2.0, 5.0, 20.0))
MAP_ALONE = Attack("2 m/s, map alone", speed_mps=2.0)
FROM_START = Attack("2 m/s, from the start", speed_mps=2.0)
SUDDEN = (
    *(Attack(f"jump of {size:g} m", jump_m=size) for size in (50.0, 100.0, 300.0, 1000.0)),
    Attack("replayed, 30 s late", late_s=30.0),
    Attack("frozen", frozen=True),
    Attack("no position", absent=True),
)
ATTACKS = (*PULLS, *SUDDEN)
