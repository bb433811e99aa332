"""The datum guard: heights of a recording are brought to the vertical datum of the maps, or refused, or doubted.

What both sides name is converted by geoid heights along the indicated track, epoch by epoch (`maps.datum.between`). The
geoid slopes by less than 0.14 m per kilometre on 99 % of the Earth (EGM2008), so the INS error matters little.

Where a side says nothing, the levels are compared: readings that lie off the map wherever in the prior the track is,
by more than an estimator allows for, are a warning. Most files say nothing and mean the same sea, so silence alone is
not worth one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import DataError
from terranav.core.kinds import kind_named
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Measurement, Prior
from terranav.io.geoid import Given, finder
from terranav.maps.datum import ELLIPSOID, Find, Shift, agreed_datum, between, stated_datum
from terranav.maps.map import Map
from terranav.sensors.ready import ready

FloatArray = NDArray[np.float64]

FEWEST = 10  # readings on the map before their level is compared with it
_MOST = 500  # readings that are compared
_MAX_AGE_S = 2.0  # of a barometer's altitude, as in sensors.ready
_LEVEL_SIGMAS = 3.0
_LIKELY = 0.35  # of the geoid height: what an offset may be away from it and still be taken for it
_HEIGHT_KINDS = ("terrain", "bathymetry")
#: directions in which the prior is probed, in units of its sigma per axis
PROBES = 3.0 * np.array([(n, e) for n in (-1.0, 0.0, 1.0) for e in (-1.0, 0.0, 1.0)])
#: column of a recording -> the kind of Measurement that its epochs carry it as
_MEASURED = {"terrain_m": "terrain", "depth_m": "bathymetry", "baro_altitude_m": "baro_altitude"}
_ALLOWING = "marginalized, or tercom with remove_mean"


@dataclass(frozen=True)
class DatumGuard:
    """What the guard may use.

    Attributes
    ----------
    geoid : path, Geoid, or several of them, optional
        Geoid grids beside those that are installed.
    allows_offset : bool or None
        Whether the estimator allows for a constant offset between readings and map (`allows_offset`); None is not
        known, and then an offset that nothing bounds is a warning.
    """

    geoid: Given = None
    allows_offset: bool | None = None

    @cached_property
    def find(self) -> Find:
        """What gives the geoid of a datum."""
        return finder(self.geoid)


@dataclass(frozen=True)
class Levelled:
    """Epochs whose readings compare with the maps, and what is to be said of their heights.

    Attributes
    ----------
    epochs : tuple of Epoch
        Ready measurements only; the altitudes are the indicated ones, as they were.
    shifted : tuple of str
        What was converted, by how much, and with which grid.
    doubts : tuple of str
        What the conversion leaves out.
    unstated : frozenset of str
        The kinds where map or readings do not name a datum.
    """

    epochs: tuple[Epoch, ...] = field(repr=False)
    shifted: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    unstated: frozenset[str] = frozenset()


def allows_offset(estimator: Any, settings: Mapping[str, Any]) -> bool:
    """Whether a method has a state for, or is indifferent to, a constant offset between readings and map.

    Parameters
    ----------
    estimator : str, Estimator or Matcher
    settings : mapping
        What the method is built with.
    """
    inner = getattr(estimator, "matcher", getattr(estimator, "estimator", estimator))
    told = settings.get("remove_mean", getattr(inner, "remove_mean", False))
    return inner == "marginalized" or hasattr(inner, "bias_sigma") or bool(told)


def levelled(rec: Recording, charts: Sequence[Map], guard: DatumGuard) -> Levelled:
    """The epochs of a recording, ready, with their heights above the datum of the maps.

    Raises
    ------
    DataError
        Two maps of a kind differ in their datum, a stated datum is not one, the ellipsoid is to be compared with the
        sea without a geoid grid at hand, or nothing bounds the difference and the estimator does not allow for one.
    """
    shifts: dict[str, Shift] = {}
    shifted, doubts, unstated = [], [], set()
    for kind in _HEIGHT_KINDS:
        own = [chart for chart in charts if chart.kind == kind]
        target = agreed_datum((chart.name, chart.datum) for chart in own)
        for column in _columns_of(rec, kind) if own else ():
            source = stated_datum(rec.datum_of(column), f"{rec.name}: vertical_datum of {column}", DataError)
            if source is None or target is None:
                unstated.add(kind)
                continue
            found = _between(f"{rec.name}: {column}", source, (own[0].name, target), guard)
            if found.doubt:
                doubts.append(f"{rec.name}: {column} and the map {own[0].name}: {found.doubt}")
            if found.geoids:
                shifts[column] = found
    heights = {column: found.heights(rec.lat_deg, rec.lon_deg) for column, found in shifts.items()}
    for column, found in shifts.items():
        low, high = heights[column].min(), heights[column].max()
        grids = ", ".join(geoid.source for geoid in found.geoids)
        shifted.append(
            f"{rec.name}: {column} was brought from {found.source} to {found.target} by {low:+.2f} to {high:+.2f} m "
            f"along the indicated track (geoid grid {grids})"
        )
    return Levelled(tuple(_ready(rec, heights)), tuple(shifted), tuple(doubts), frozenset(unstated))


def _between(what: str, source: str, at: tuple[str, str], guard: DatumGuard) -> Shift:
    """The shift to a map, (its name, its datum); errors name both sides."""
    name, target = at
    try:
        found = between(source, target, guard.find)
    except DataError as problem:
        raise DataError(f"{what} counts from {source}, but the map {name} from {target}: {problem}") from None
    if not found.bounded and guard.allows_offset is False:
        raise DataError(
            f"{what} counts from {source}, but the map {name} from {target}: {found.doubt}, and this estimator does "
            f"not allow for it; expected one datum, or an estimator that does ({_ALLOWING})"
        )
    return found


def _columns_of(rec: Recording, kind: str) -> tuple[str, ...]:
    """The columns whose heights end up in measurements of a kind, as sensors.ready makes them."""
    if kind == "bathymetry":
        return ("depth_m",) if "depth_m" in rec.readings else ()
    found = ["terrain_m"] if "terrain_m" in rec.readings else []
    raw = [np.isfinite(rec.columns[key]) for key in ("radar_altitude_m", "laser_altitude_m") if key in rec.readings]
    if not raw:
        return tuple(found)
    if "baro_altitude_m" in rec.readings:
        found.append("baro_altitude_m")
        at = rec.time_s[np.isfinite(rec.columns["baro_altitude_m"])]
        when = rec.time_s[np.any(raw, axis=0)]
        last = np.searchsorted(at, when, side="right") - 1
        if ((last >= 0) & (when - at[last] <= _MAX_AGE_S)).all():
            return tuple(found)
    return (*found, "alt_m")


def _ready(rec: Recording, heights: Mapping[str, FloatArray]) -> Iterator[Epoch]:
    """The epochs, ready, with what is to be added to each column in them; the indicated altitude stays as it is."""
    if not heights:
        yield from ready(rec.epochs())
        return
    by_kind = {_MEASURED[column]: added for column, added in heights.items() if column in _MEASURED}
    epochs = tuple(rec.epochs())
    altitude = heights.get("alt_m", np.zeros(len(epochs)))

    def moved(i: int, epoch: Epoch) -> Epoch:
        readings = tuple(_added(m, by_kind[m.kind][i]) if m.kind in by_kind else m for m in epoch.measurements)
        return replace(epoch, alt_m=epoch.alt_m + float(altitude[i]), measurements=readings)

    for epoch, done in zip(epochs, ready(moved(i, epoch) for i, epoch in enumerate(epochs)), strict=True):
        yield replace(done, alt_m=epoch.alt_m)


def _added(reading: Measurement, height_m: float) -> Measurement:
    return replace(reading, value=reading.value + float(height_m))


def level_doubt(rec: Recording, chart: Map, epochs: Sequence[Epoch], prior: Prior, guard: DatumGuard) -> str:
    """What is to be said of readings that lie off a map wherever in the prior the track is; empty where nothing.

    Parameters
    ----------
    rec, chart : Recording, Map
        Of which one at least does not name its datum.
    epochs : sequence of Epoch
        Ready.
    prior : Prior
        Of the INS error; the track is probed to 3 sigma on both axes.
    guard : DatumGuard
    """
    pairs = [(e.lat_deg, e.lon_deg, m.value, m.sigma) for e in epochs for m in e.measurements if m.kind == chart.kind]
    lat, lon, measured, sigma = np.array(pairs[:: -(-len(pairs) // _MOST) or 1]).reshape(-1, 4).T
    spread = np.sqrt(np.diag(prior.cov_m2))
    levels = []
    for north, east in prior.mean_m + PROBES * spread:
        off = measured - chart.sample(*shift(lat, lon, -north, -east))
        if np.isfinite(off).sum() >= FEWEST:
            levels.append(float(np.nanmedian(off)))
    if not levels or min(levels) < 0.0 < max(levels):
        return ""
    least = min(levels, key=abs)
    kind = kind_named(chart.kind)
    allowed = max(
        kind.bias_sigma * (2.0 if guard.allows_offset else 1.0),
        _LEVEL_SIGMAS * float(np.hypot(np.median(sigma), chart.sigma)),
    )
    if abs(least) <= allowed:
        return ""
    unnamed = "neither names" if not rec.datum and chart.datum is None else "one does not name"
    hint = _likely(least, (float(lat[0]), float(lon[0])), guard.find)
    where = "above" if least > 0.0 else "below"
    return (
        f"{rec.name}: the {chart.kind} readings lie at least {abs(least):.0f} m {where} {chart.name}, and {unnamed} "
        f"its vertical datum{hint}; say what heights count from (vertical_datum of the recording, datum= of the map), "
        f"or use an estimator with a bias ({_ALLOWING})"
    )


def _likely(off_m: float, place_deg: tuple[float, float], find: Find) -> str:
    """Whether an offset is about what the geoid is from the ellipsoid at a place, in words."""
    geoid = find("EGM2008") or find("EGM96")
    height = float(geoid.height(*place_deg)) if geoid is not None else float("nan")
    if not abs(abs(off_m) - abs(height)) <= _LIKELY * abs(height):  # not so for NaN either
        return ""
    which = "do the readings" if off_m * height > 0.0 else "does the map"
    return f" (the geoid is {height:+.0f} m from the ellipsoid here: {which} count from the {ELLIPSOID}?)"
