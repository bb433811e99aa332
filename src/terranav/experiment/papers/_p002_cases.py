"""The two flights of papers/002, section 5: the land and the gravity below them, the INS, and one run of every mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import GRAVITY_MPS2, metres_per_degree, offset_m, shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.stream import states
from terranav.filters.hybrid import Hybrid, mixed_moments
from terranav.filters.pointmass import PointMass
from terranav.ins.drift import add_drift
from terranav.ins.grades import grade_named
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]

TERRAIN_CELL_S, GRAVITY_CELL_S = 3.0, 30.0  # [arcsec]
SPEED_MPS, DURATION_S = 100.0, 200.0
LENGTH_M = SPEED_MPS * DURATION_S
MARGIN_M = 1500.0  # of map around the track: the search area and the drift
CLEARANCE_M = 3000.0
#: of every filter; the default finest cell, 1/20 of the map's, is 46 m for gravity: too coarse for what 0.01 mGal tells
MIN_CELL_M, MAX_CELLS = 2.0, 20_000
SENSOR_SHARE = 0.1  # of the map's noise: the sensor's own, where the stated noise is the map's

TERRAIN, GRAVITY, MIX, JOINT = "terrain only", "gravity only", "kurtosis mix", "joint likelihood"
OWN, POSITION, FED_BACK = "kurtosis over own grids", "kurtosis of the position", "kurtosis mix, fed back"
MODES = (TERRAIN, GRAVITY, MIX, JOINT)
READINGS = (OWN, POSITION, FED_BACK)


@dataclass(frozen=True)
class Terms:
    """What the paper states of noise and INS, and one reading of each point it leaves open.

    Attributes
    ----------
    noise_in : str
        Where the stated noise is: 'reading' (drawn anew for each reading: the v_t of eq. 1, the only noise that the
        paper's filter knows) or 'map' (a fixed error of each map cell, as "accuracy of the database" would have it).
    terrain_sigma_m, gravity_sigma_mgal : float
    accel_walk_mps_per_sqrt_h : float
        The printed '5 ug/sqrt(hr)'.
    velocity_sigma_mps : float
        Initial velocity error, of which the paper says nothing.
    """

    noise_in: str = "reading"
    terrain_sigma_m: float = 10.0
    gravity_sigma_mgal: float = 0.01
    accel_walk_mps_per_sqrt_h: float = 5e-6 * GRAVITY_MPS2 * 60.0  # read as 5 ug/sqrt(Hz)
    velocity_sigma_mps: float = 0.0

    def __post_init__(self) -> None:
        if self.noise_in not in ("map", "reading"):
            raise ConfigError(f"noise_in is {self.noise_in!r}, expected 'map' or 'reading'")
        for key in ("terrain_sigma_m", "gravity_sigma_mgal"):
            if not 0.0 < getattr(self, key) < np.inf:
                raise ConfigError(f"{key} is {getattr(self, key)!r}, expected a positive number")

    def ins(self) -> InsGrade:
        """The INS of Table 1."""
        return replace(
            grade_named("paper_002"),
            velocity_sigma_mps=self.velocity_sigma_mps,
            accel_walk_mps_per_sqrt_h=self.accel_walk_mps_per_sqrt_h,
        )

    def sigma(self, kind: str) -> float:
        """The stated noise of one kind, in its unit."""
        return self.terrain_sigma_m if kind == "terrain" else self.gravity_sigma_mgal


@dataclass(frozen=True)
class Case:
    """One flight: a straight track over a terrain map, and gravity that is drawn for each run or given.

    Attributes
    ----------
    name, land : str
        'A' or 'B'; what the land is.
    terrain : Map
    lat_deg, lon_deg : (n,) the true track, one position a second [deg]
    gravity : Map or None
        Given by the user; None draws a field.
    gravity_std_mgal, gravity_correlation_m : float
        Of the field that is drawn.
    """

    name: str
    land: str
    terrain: Map
    lat_deg: FloatArray
    lon_deg: FloatArray
    gravity: Map | None
    gravity_std_mgal: float
    gravity_correlation_m: float

    def true_maps(self, rng: Generator) -> tuple[Map, Map]:
        """Terrain and gravity as they truly are."""
        if self.gravity is not None:
            return self.terrain, self.gravity
        middle = len(self.lat_deg) // 2
        centre = float(self.lat_deg[middle]), float(self.lon_deg[middle])
        cell_m = GRAVITY_CELL_S / 3600.0 * float(metres_per_degree(centre[0])[0])
        # the field is periodic: a map of some correlation lengths, so that its two ends are not alike
        cells = int(np.ceil(max(4.0 * self.gravity_correlation_m, 1.5 * LENGTH_M) / cell_m))
        drawn = gaussian_map(
            rng,
            std=self.gravity_std_mgal,
            correlation_m=self.gravity_correlation_m,
            mean=0.0,
            cells=cells,
            cell_m=cell_m,
            centre_deg=centre,
            kind="gravity",
        )
        return self.terrain, drawn


def cases(maps: Sequence[Map], seed: int) -> tuple[Case, Case]:
    """The rough and the flat case.

    Parameters
    ----------
    maps : sequence of Map
        Empty: case A flies the roughest straight track over the sample DEM, case B a flat field of the same 3 arcsec
        (nowhere is the sample DEM flat); a given terrain map: its roughest and its flattest track. A given gravity map
        replaces the drawn fields.
    seed : int
        Of the generated terrain.

    Raises
    ------
    DataError
        A map of another kind, a terrain map too small for the flight, maps that do not overlap along it.
    """
    given = {}
    for chart in maps:
        if chart.kind not in ("terrain", "gravity"):
            raise DataError(f"{chart.name}: map of kind {chart.kind}, expected terrain or gravity for paper 002")
        given[chart.kind] = chart
    gravity = given.get("gravity")
    if "terrain" in given:
        rough, flat = given["terrain"], given["terrain"]
        rough_track, flat_track = _track(rough, rough=True), _track(flat, rough=False)
        lands = (f"roughest track over {rough.name}", f"flattest track over {flat.name}")
    else:
        rough = sample_map()
        flat = _flat_land(rough.centre_deg, seed)
        rough_track, flat_track = _track(rough, rough=True), _track(flat, rough=False)
        lands = ("sample DEM, roughest track", "generated field, 15 m rms, correlation 1.5 km")
    for (lat, lon), chart in ((rough_track, rough), (flat_track, flat)):
        if gravity is not None and not np.isfinite(gravity.sample(lat, lon)).all():
            raise DataError(
                f"{gravity.name}: does not cover the track over {chart.name} from {lat[0]:.4f} N {lon[0]:.4f} E to "
                f"{lat[-1]:.4f} N {lon[-1]:.4f} E, expected a gravity map that overlaps the terrain map there"
            )
    return (
        Case("A", lands[0], rough, *rough_track, gravity, 12.0, 31_000.0),
        Case("B", lands[1], flat, *flat_track, gravity, 25.0, 14_000.0),
    )


@dataclass(frozen=True)
class Flown:
    """Horizontal error [m] (n,) and squared error over claimed variance (n,) of each mode in one run."""

    error_m: dict[str, FloatArray]
    nees: dict[str, FloatArray]
    weight_terrain: FloatArray


def fly(case: Case, terms: Terms, seeds: SeedSequence, *, readings: bool = False) -> Flown:
    """Fly one run of every mode over the same truth, drift and noise.

    Parameters
    ----------
    case : Case
    terms : Terms
    seeds : SeedSequence
    readings : bool
        Whether the other readings of the mix are flown too.
    """
    fields_seed, drift_seed, noise_seed = seeds.spawn(3)
    true = case.true_maps(np.random.default_rng(fields_seed))
    rec, known = _measured(case, terms, true, drift_seed, np.random.default_rng(noise_seed))
    ins, prior, epochs = terms.ins(), Prior.from_ins(terms.ins()), list(rec.epochs())
    rng = np.random.default_rng(0)  # point-mass filters draw nothing
    hybrid = Hybrid(known, ins, min_cell_m=MIN_CELL_M, max_cells=MAX_CELLS)
    others = {OWN: replace(hybrid, kurtosis="own"), POSITION: replace(hybrid, kurtosis="position")}
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {mode: [] for mode in MODES}
    found |= {mode: [] for mode in READINGS} if readings else {}
    weight = []
    for state, epoch in zip(states(hybrid, prior, epochs, rng), epochs, strict=True):
        means, covs = [part.mean_m for part in state.parts], [part.cov_m2 for part in state.parts]
        found[TERRAIN].append((means[0], covs[0]))
        found[GRAVITY].append((means[1], covs[1]))
        found[MIX].append((state.mean_m, state.cov_m2))
        weight.append(float(state.weights[0]))
        if readings:
            for label, other in others.items():
                found[label].append(mixed_moments(other.weigh(state.parts, epoch), means, covs))
    joint = PointMass(known, ins, min_cell_m=MIN_CELL_M, max_cells=MAX_CELLS)
    found[JOINT] = [(s.mean_m, s.cov_m2) for s in states(joint, prior, epochs, rng)]
    if readings:
        fed = replace(hybrid, feedback=True)
        found[FED_BACK] = [(s.mean_m, s.cov_m2) for s in states(fed, prior, epochs, rng)]
    error, nees = {}, {}
    for mode, moments in found.items():
        away = np.stack([mean for mean, _ in moments]) - rec.ins_error_m()
        solved = np.linalg.solve(np.stack([cov for _, cov in moments]), away[:, :, None])[:, :, 0]
        error[mode], nees[mode] = np.hypot(away[:, 0], away[:, 1]), (away * solved).sum(axis=1)
    return Flown(error, nees, np.array(weight))


def _measured(
    case: Case, terms: Terms, true: tuple[Map, Map], drift_seed: SeedSequence, rng: Generator
) -> tuple[Recording, tuple[Map, Map]]:
    """What the INS and the sensors say, and the maps that the filters are given."""
    time_s = np.arange(case.lat_deg.size, dtype=np.float64)
    height = np.full(time_s.size, float(np.mean(case.terrain.sample(case.lat_deg, case.lon_deg))) + CLEARANCE_M)
    columns = {"time_s": time_s, "lat_deg": case.lat_deg, "lon_deg": case.lon_deg, "alt_m": height}
    known, sigma = [], {}
    for chart, column in zip(true, ("terrain_m", "gravity_mgal"), strict=True):
        noise = terms.sigma(chart.kind)
        in_map = terms.noise_in == "map"
        sigma[column] = SENSOR_SHARE * noise if in_map else noise
        drawn = rng.standard_normal(time_s.size)
        columns[column] = chart.sample(case.lat_deg, case.lon_deg) + sigma[column] * drawn
        error = noise * rng.standard_normal(chart.shape) if in_map else 0.0
        known.append(replace(chart, values=chart.values + error, sigma=noise if in_map else 0.0))
    rec = Recording(columns, sigma=sigma, name=f"papers/002 case {case.name}")
    return add_drift(rec, terms.ins(), np.random.default_rng(drift_seed)), (known[0], known[1])


def _flat_land(centre_deg: tuple[float, float], seed: int) -> Map:
    """Flat land of 3 arcsec cells: 15 m rms, correlation 1.5 km, so a slope of 0.014 on each axis."""
    cell_m = TERRAIN_CELL_S / 3600.0 * float(metres_per_degree(centre_deg[0])[0])
    return gaussian_map(
        np.random.default_rng(SeedSequence([seed, 2])),
        std=15.0,
        correlation_m=1500.0,
        mean=60.0,
        cells=320,
        cell_m=cell_m,
        centre_deg=centre_deg,
    )


def _track(chart: Map, *, rough: bool) -> tuple[FloatArray, FloatArray]:
    """The roughest or flattest of the straight tracks north or east that the map holds with a margin."""
    south, west, north, east = chart.bounds_deg
    lat0, lon0 = chart.centre_deg
    height, width = (float(x) for x in offset_m(south, west, north, east))
    along = SPEED_MPS * np.arange(int(DURATION_S) + 1)
    best: tuple[float, FloatArray, FloatArray] | None = None
    for northward, length, across in ((True, height, width), (False, width, height)):
        spare, side = length - LENGTH_M - 2.0 * MARGIN_M, across - 2.0 * MARGIN_M
        if spare < 0.0 or side < 0.0:
            continue
        for start in np.linspace(0.0, spare, 3):
            for offset in np.linspace(-0.5 * side, 0.5 * side, 13):
                ahead, aside = along + start - 0.5 * (LENGTH_M + spare), np.full(along.size, offset)
                lat, lon = shift(lat0, lon0, *((ahead, aside) if northward else (aside, ahead)))
                slope = float(np.sqrt(np.mean(np.square(chart.gradient(lat, lon)).sum(axis=0))))
                better = best is None or (slope > best[0] if rough else slope < best[0])
                if np.isfinite(slope) and better:
                    best = slope, lat, lon
    if best is None:
        raise DataError(
            f"{chart.name}: map of {height / 1e3:.1f} x {width / 1e3:.1f} km without a straight track of "
            f"{LENGTH_M / 1e3:.0f} km free of voids and {MARGIN_M / 1e3:g} km from its edges, expected room for one"
        )
    return best[1], best[2]
