"""What a run is given, checked once and made ready: the same for every estimator that is compared."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from terranav.core.earth import shift
from terranav.core.errors import DataError, DataWarning
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import DEFAULT_RAW_SIGMA_M, READY, Recording
from terranav.core.records import Epoch, Prior
from terranav.experiment.datums import PROBES, DatumGuard, level_doubt, levelled
from terranav.maps.map import Map, as_maps

FEET_PER_METRE = 1.0 / 0.3048
FEWEST_FOR_DOUBT = 10  # readings on the map before their level is compared with it


@dataclass(frozen=True)
class Inputs:
    """A recording, maps, an INS and a prior that go together.

    Attributes
    ----------
    rec : Recording
    maps : tuple of Map
    ins : InsGrade
    prior : Prior
    epochs : tuple of Epoch
        Ready measurements only; no truth.
    assumed : tuple of str
        What the recording did not say and was assumed, what looked suspicious, and which heights were converted.
    """

    rec: Recording
    maps: tuple[Map, ...]
    ins: InsGrade
    prior: Prior
    epochs: tuple[Epoch, ...] = field(repr=False)
    assumed: tuple[str, ...] = ()


def prepare(
    rec: Recording,
    maps: Sequence[Map] | Map,
    ins: InsGrade | None,
    prior: Prior | None,
    *,
    needs_maps: bool,
    guard: DatumGuard | None = None,
) -> Inputs:
    """Check what a run is given and make its epochs ready.

    Parameters
    ----------
    rec : Recording
    maps : sequence of Map, or one
    ins : InsGrade, optional
        Else the recording's, else the default one, with a warning.
    prior : Prior, optional
        Else zero mean and the initial position sigma of the INS.
    needs_maps : bool
        Whether any estimator compares readings with maps.
    guard : DatumGuard, optional
        What brings the readings to the vertical datum of the maps.

    Returns
    -------
    Inputs

    Raises
    ------
    DataError
        No map, no reading that a map can be compared with, a map that lies away from the recording, or vertical datums
        that cannot be brought together.

    Warns
    -----
    DataWarning
        A grade or a sigma is assumed, the map covers a part of the track only, its values look like feet, or their
        level or their vertical datum does not quite go with that of the readings.
    """
    charts = as_maps(maps)
    assumed: list[str] = []
    grade = ins if ins is not None else rec.ins
    if grade is None:
        grade = InsGrade()
        assumed.append(
            f"{rec.name}: nothing is said about the INS; assumed position_sigma_m = {grade.position_sigma_m:g}, "
            f"velocity_sigma_mps = {grade.velocity_sigma_mps:g}, "
            f"position_walk_m_per_sqrt_s = {grade.position_walk_m_per_sqrt_s:g}"
        )
    prior = Prior.from_ins(grade) if prior is None else prior
    guard = guard or DatumGuard()
    level = levelled(rec, charts if needs_maps else (), guard)
    if needs_maps:
        _check_kinds(rec, charts, level.epochs)
        assumed += _assumed_sigmas(rec)
        assumed += _check_cover(rec, charts, prior)
        assumed += level.doubts
        for chart in charts:
            feet = _doubts(rec, chart, level.epochs)
            unstated = chart.kind in level.unstated and not feet
            assumed += feet or [level_doubt(rec, chart, level.epochs, prior, guard)] * unstated
    assumed = [text for text in assumed if text]
    for text in assumed:
        warnings.warn(text, DataWarning, stacklevel=3)
    return Inputs(rec, charts, grade, prior, level.epochs, (*assumed, *level.shifted))


def _check_kinds(rec: Recording, maps: tuple[Map, ...], epochs: tuple[Epoch, ...]) -> None:
    """Raise DataError when there is nothing to compare."""
    if not maps:
        raise DataError(f"{rec.name}: no map is given, expected at least one (the estimator 'ins' alone needs none)")
    measured = sorted({reading.kind for epoch in epochs for reading in epoch.measurements})
    mapped = sorted({chart.kind for chart in maps})
    if not measured:
        raise DataError(f"{rec.name}: holds no reading, expected at least one of kind {' or '.join(mapped)}")
    if not set(measured) & set(mapped):
        raise DataError(
            f"{rec.name}: holds readings of kind {', '.join(measured)}, but the maps are of kind {', '.join(mapped)}"
        )


def _assumed_sigmas(rec: Recording) -> list[str]:
    """One line that states the sigmas which the recording leaves out."""
    texts = []
    for key in rec.readings:
        values = rec.columns[key]
        unit = READY[key].unit if key in READY else "m"
        default = READY[key].default_sigma if key in READY else DEFAULT_RAW_SIGMA_M[key]
        own = rec.columns.get(READY[key].sigma_column) if key in READY else None
        bare = np.isfinite(values) if own is None else np.isfinite(values) & ~np.isfinite(own)
        if key not in rec.sigma and bare.any():
            texts.append(f"{key} = {default:g} {unit}")
    return [f"{rec.name}: no sigma is given for some readings; assumed {', '.join(texts)}"] if texts else []


def _check_cover(rec: Recording, maps: tuple[Map, ...], prior: Prior) -> list[str]:
    """Raise DataError when the prior about the track misses a map; one line when the track leaves them all."""
    mean, sigma = prior.mean_m, np.sqrt(np.diag(prior.cov_m2))
    north, east = (mean + PROBES * sigma).T[:, :, None]
    reach = shift(rec.lat_deg, rec.lon_deg, -north, -east)
    away = [chart for chart in maps if not chart.covers(*reach).any()]
    if away:
        extents = "; ".join(f"{chart.name} spans {_extent(*chart.bounds_deg)}" for chart in away)
        which = "no map covers" if len(away) == len(maps) else f"the {away[0].kind} map does not cover"
        raise DataError(f"{rec.name}: the track spans {_track_extent(rec)}, which {which} ({extents})")
    inside = np.any([chart.covers(rec.lat_deg, rec.lon_deg) for chart in maps], axis=0)
    share = float(np.mean(inside))
    return [] if share == 1.0 else [f"{rec.name}: the maps cover {100.0 * share:.1f} % of the indicated positions"]


def _doubts(rec: Recording, chart: Map, epochs: tuple[Epoch, ...]) -> list[str]:
    """One line when readings and map differ by the ratio of feet and metres, a wrong unit that no file states."""
    if chart.unit != "m":
        return []
    pairs = [(e.lat_deg, e.lon_deg, m.value) for e in epochs for m in e.measurements if m.kind == chart.kind]
    lat, lon, measured = np.array(pairs).reshape(-1, 3).T
    mapped = chart.sample(lat, lon)
    known = np.isfinite(mapped)
    if known.sum() < FEWEST_FOR_DOUBT:
        return []
    here, there = float(np.median(measured[known])), float(np.median(mapped[known]))
    for factor, what in ((FEET_PER_METRE, "the map"), (1.0 / FEET_PER_METRE, "the readings")):
        spread = 3.0 * float(np.std(mapped[known])) / factor + 5.0 * chart.sigma
        near, far = abs(here - there / factor), abs(here - there)
        if near < 0.1 * abs(here) and far > spread:
            return [
                f"{rec.name}: the median {chart.kind} reading is {here:.0f} m where {chart.name} has {there:.0f} m; "
                f"is the unit of {what} feet?"
            ]
    return []


def _track_extent(rec: Recording) -> str:
    """South, west, north, east of the indicated track, as text; its longitudes taken about the first."""
    east = (rec.lon_deg - rec.lon_deg[0] + 180.0) % 360.0 - 180.0 + rec.lon_deg[0]
    return _extent(float(rec.lat_deg.min()), float(east.min()), float(rec.lat_deg.max()), float(east.max()))


def _extent(south: float, west: float, north: float, east: float) -> str:
    return f"{south:.4f} to {north:.4f} N, {west:.4f} to {east:.4f} E"
