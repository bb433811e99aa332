"""Where on a whole map was this profile flown? No prior position; the answer comes with a proof.

A track of known shape (metres north and east, as indicated over a minute or more) and the heights under it are placed
anywhere on a map, turned by an unknown heading, stretched by an unknown scale (a wrong speed or odometer) and lifted by
an unknown height offset. Blocks of placements are left out when a lower bound of their misfit exceeds that of the best
by a margin (`kernels.locating`), from blocks of 64 cells down to one cell, and a heading and scale step that each move
the track's ends by a quarter of a cell. The bound holds for every position between the cells and every heading and
scale between the steps, so nothing better than the margin is skipped. What remains is fitted below the cell by least
squares, and weighed by the integral of its likelihood over all that was kept of it (`planning._weigh`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terranav.core.checks import finite
from terranav.core.earth import offset_of, shift
from terranav.core.errors import ConfigError, DataError, StateError
from terranav.core.records import Prior
from terranav.maps.map import Map
from terranav.planning._fits import Fit, cov_at_end, fitted
from terranav.planning._placements import Search, lat_lon, searched, shapes_of, tables_of
from terranav.planning._track import Track, spread_order, thinned
from terranav.planning._weigh import weighed

__all__ = ["LocateSettings", "Located", "Place", "Track", "locate"]

FloatArray = NDArray[np.float64]

FIRST_FITS, MOST_FITS = 8, 60  # places fitted below the cell: for a first limit, and at last
MOST_STOPPED = 4000  # cells and headings looked at closer where the search was stopped
PARTS = (0.3, 0.6)  # of the misfit that is usual at most, tried first: a low limit is soon searched
LEAST_VOLUME = 1e-5  # of a cell, heading and scale that a place is taken to fill until that is known
WEIGHED = 30.0  # misfit above the best up to which a place is weighed by integration
MOST_SIGMA_CELLS = 0.75  # of a place that counts as known: within two cells at 99 %
NOISES = (1.0, 3.0, 10.0, 30.0, 100.0)  # by which the variances grow until some place fits
BELIEVED_NOISE = 3.0  # beyond which the profile is taken to lie on no place of the map
MOST_SCALE = 0.2


@dataclass(frozen=True)
class LocateSettings:
    """How wide to search, and what is certain.

    Attributes
    ----------
    heading_deg : float
        Largest heading error either way, in [0, 180] [deg], all of it equally likely; the time grows with it.
    offset_sigma : float
        1-sigma of the common height offset, > 0, by default unknown [unit of the map].
    certain : float
        Probability of the best place below which the answer is ambiguous, in (0, 1).
    tail : float
        Share of the probability that may lie in what was left out, in (0, 1); what it came to is reported.
    most_places : int
        Cells times headings and scales that may be kept; where more fit, the search stops and the answer is ambiguous.
    scale : float
        Largest error of lengths along the track either way, in [0, 0.2]: 0.02 is 2 %; equally likely likewise.

    Raises
    ------
    ConfigError
        For a value out of its range.
    """

    heading_deg: float = 2.0
    offset_sigma: float = math.inf
    certain: float = 0.99
    tail: float = 1e-3
    most_places: int = 20_000
    scale: float = 0.0

    def __post_init__(self) -> None:
        finite("heading_deg", self.heading_deg, minimum=0.0, maximum=180.0)
        finite("scale", self.scale, minimum=0.0, maximum=MOST_SCALE)
        if self.offset_sigma != math.inf:
            finite("offset_sigma", self.offset_sigma, above=0.0)
        for name in ("certain", "tail"):
            if finite(name, getattr(self, name), above=0.0) >= 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)!r}, expected a number between 0 and 1")
        most = finite("most_places", self.most_places, minimum=1, maximum=100_000_000)
        object.__setattr__(self, "most_places", int(most))


@dataclass(frozen=True)
class Place:
    """One placement of the track.

    Attributes
    ----------
    lat_deg, lon_deg, first_lat_deg, first_lon_deg : float
        Of the track's last and first point [deg].
    heading_deg : float
        By which the track is to be turned clockwise [deg].
    scale : float
        By which share its lengths are to grow.
    offset, rms : float
        Heights given less the map's, and what remains after it [unit of the map].
    misfit : float
        Sum of squares over variances; about the number of points where the place is right.
    sigma_m : float
        1-sigma of the last point along its worse axis, the candidate being the right one [m].
    cov_m2 : (2, 2) float64
        Covariance of the last point, north and east [m^2].
    probability : float
        Among all that was kept; see `Located.tail` for what may lie outside it. NaN where the search was stopped: among
        a part of what fits it means nothing.
    """

    lat_deg: float
    lon_deg: float
    first_lat_deg: float
    first_lon_deg: float
    heading_deg: float
    scale: float
    offset: float
    rms: float
    misfit: float
    sigma_m: float
    cov_m2: FloatArray = field(repr=False)
    probability: float

    def under(self, track: Track) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude of every point of the track, placed here: two arrays (n,) [deg]."""
        turn, factor = math.radians(self.heading_deg), 1.0 + self.scale
        north, east = track.north_m - track.north_m[-1], track.east_m - track.east_m[-1]
        cos, sin = factor * math.cos(turn), factor * math.sin(turn)
        return shift(self.lat_deg, self.lon_deg, north * cos - east * sin, north * sin + east * cos)


@dataclass(frozen=True)
class Located:
    """The places found, the likeliest first, and how sure that is.

    Attributes
    ----------
    candidates : tuple of Place
    ambiguous : bool
    reasons : tuple of str
        Why it is ambiguous, or empty.
    complete : bool
        Whether the search came to its end, so that nothing within `margin` of the best misfit was skipped.
    margin, tail : float
        That margin, and the share of the probability that may lie outside it at most.
    noise : float
        By which the variances had to grow until some place fitted.
    blocks, lookups : int
        Blocks bounded, and points looked up for that.
    share : float
        Those lookups over what all cells, heading and scale steps and points would have taken.
    """

    candidates: tuple[Place, ...]
    ambiguous: bool
    reasons: tuple[str, ...]
    complete: bool
    margin: float
    tail: float
    noise: float
    blocks: int
    lookups: int
    share: float

    @property
    def verdict(self) -> str:
        """'found', 'ambiguous', 'not found', or 'not searched to the end'."""
        if not self.ambiguous:
            return "found"
        if not self.complete:
            return "not searched to the end"
        return "not found" if not self.candidates or self.noise > BELIEVED_NOISE else "ambiguous"

    def prior(self, lat_deg: float, lon_deg: float) -> Prior:
        """What an estimator may start from: the INS error at the track's last point.

        Parameters
        ----------
        lat_deg, lon_deg : float
            As the INS indicates it there [deg].

        Raises
        ------
        StateError
            The answer is ambiguous: no one place is known.
        """
        if self.ambiguous:
            raise StateError(f"no prior from a place that is {self.verdict}: {'; '.join(self.reasons)}")
        best = self.candidates[0]
        return Prior(np.array(offset_of(best.lat_deg, best.lon_deg, lat_deg, lon_deg)), best.cov_m2)


def locate(track: Track, chart: Map, settings: LocateSettings | None = None) -> Located:
    """Find a profile anywhere on a map.

    Parameters
    ----------
    track : Track
        The whole of it must lie on the map; voids are allowed at a cost.
    chart : Map
        Its values are read whole.
    settings : LocateSettings, optional

    Returns
    -------
    Located

    Raises
    ------
    DataError
        The track is longer than the map is wide, or shorter than three of its cells.
    ConfigError
        So many headings and scales of so long a track do not fit into memory.
    """
    settings = settings or LocateSettings()
    work = _prepared(track, chart, settings)
    usual = float(chi2.ppf(0.9999, work.height.size))
    most, complete, noise, margin = settings.most_places, False, 1.0, _margin(work, settings.tail, 0.0)
    fits, leaves, left = list[Fit](), list[FloatArray](), np.empty((0, 5))
    for noise, part in [(1.0, part) for part in PARTS] + [(noise, 1.0) for noise in NOISES]:
        weight = work.weight / noise  # first some place that fits, then all that are within the margin of it
        kept, _, complete = searched(work, weight, part * usual, 0.0, most)
        fits, leaves, left = fitted(work, weight, _looked_at(kept, complete), margin, FIRST_FITS)
        if fits and fits[0].misfit <= usual:
            margin = _margin(work, 0.5 * settings.tail, weighed(work, weight, fits[0], leaves[0]).volume)
            kept, limit, complete = searched(work, weight, fits[0].misfit + margin, margin, most)
            fits, leaves, left = fitted(work, weight, _looked_at(kept, complete), margin, MOST_FITS)
            margin = max(limit - fits[0].misfit, 0.0)
            break
        if not complete:
            break
    fits = [
        weighed(work, work.weight / noise, fit, cells) if fit.misfit <= fits[0].misfit + WEIGHED else fit
        for fit, cells in zip(fits, leaves, strict=True)
    ]
    return _judged(work, fits, settings, (margin, noise, complete, left))


def _looked_at(kept: FloatArray, complete: bool) -> FloatArray:
    """All that was kept; of a search that was stopped, which gives no answer anyway, what fits best as it stands."""
    return kept if complete else kept[np.argsort(kept[:, 4], kind="stable")[:MOST_STOPPED]]


def _margin(work: Search, tail: float, volume: float) -> float:
    """Misfit above the best that leaves at most a share `tail` outside, the best place having a volume."""
    least = LEAST_VOLUME * work.leaf
    return 2.0 * math.log(work.values.size * work.whole / (tail * max(volume, least)))


def _prepared(track: Track, chart: Map, settings: LocateSettings) -> Search:
    """The profile thinned and ordered, and the tables of the map."""
    if track.length_m < 3.0 * chart.cell_m:
        raise DataError(
            f"the profile is {track.length_m:.0f} m long, expected at least three cells of the map {chart.name} "
            f"({3.0 * chart.cell_m:.0f} m)"
        )
    values = chart.values
    chosen = thinned(track, chart.cell_m)
    along, height = track.along_m[chosen], track.height[chosen]
    # the map's error is correlated along the track: its part of the variance counts as often as it repeats
    repeats = float(np.exp(-np.abs(along[:, None] - along) / chart.error_length_m).sum(axis=1).mean())
    variance = track.sigma**2 + repeats * chart.sigma**2
    order = spread_order(height, along)
    points = np.array([track.north_m[chosen], track.east_m[chosen]])[:, order]
    points -= 0.5 * (points.min(axis=1) + points.max(axis=1))[:, None]
    reach = float(np.hypot(*points).max()) / chart.cell_m
    if reach > math.hypot(*values.shape):
        raise DataError(f"the track reaches {2 * reach:.0f} cells, expected less than the map {chart.name} is wide")
    half = math.radians(settings.heading_deg)
    told = shapes_of(half, settings.scale, reach)
    tables, spans = tables_of(values)
    return Search(
        chart, values, points, along[order], height[order], np.full(order.size, 1.0 / variance),
        settings.offset_sigma**-2.0, 1.0 + math.log1p(float(np.nanvar(values.astype(np.float64))) / variance),
        half, settings.scale, tables, spans, told.begins, told.mids, told.halves, told.parts,
    )  # fmt: skip


def _judged(
    work: Search, fits: list[Fit], settings: LocateSettings, found: tuple[float, float, bool, FloatArray]
) -> Located:
    """Probabilities, and whether they allow an answer."""
    margin, noise, complete, left = found
    mass = np.array([math.exp(-0.5 * (fit.misfit - fits[0].misfit)) * fit.volume for fit in fits])
    rest = float(np.exp(-0.5 * (left[:, 4] - fits[0].misfit)).sum()) * work.leaf if fits else 0.0
    share = mass / (mass.sum() + rest) if len(fits) else mass
    ranked = np.argsort(-share, kind="stable")
    places = tuple(_place(work, fits[k], float(share[k]) if complete else math.nan) for k in ranked)
    tail = (
        work.values.size * work.whole * math.exp(-0.5 * margin) / max(float(mass.sum()), 1e-300)
        if fits and complete
        else 1.0
    )
    reasons = _doubts(work, places, settings, (noise, complete, len(left)))
    return Located(
        places, bool(reasons), reasons, complete, margin, min(tail, 1.0), noise,
        int(work.counts[1]), int(work.counts[2]), float(work.counts[2]) / work.lookups_of_all,
    )  # fmt: skip


def _doubts(
    work: Search, places: tuple[Place, ...], settings: LocateSettings, found: tuple[float, bool, int]
) -> tuple[str, ...]:
    """Why the answer is ambiguous; empty where it is not."""
    noise, complete, left = found
    reasons = []
    if not complete:
        reasons.append(
            f"search stopped: more than {settings.most_places} cells and headings fit, too little relief to search all"
        )
    if left:
        reasons.append(f"{left} cells and headings fit that were not looked at closer")
    if not places:
        reasons.append("no place on the map fits")
    elif complete and places[0].probability < settings.certain:
        reasons.append(f"the best place has a probability of {places[0].probability:.3f} among {len(places)} places")
    if places and places[0].sigma_m > MOST_SIGMA_CELLS * work.chart.cell_m:
        reasons.append(f"the best place is known to {places[0].sigma_m:.0f} m (1-sigma) along one axis alone")
    if noise > 1.0 and places:
        reasons.append(f"no place fits unless the variances are {noise:g} times as large")
    return tuple(reasons)


def _place(work: Search, fit: Fit, probability: float) -> Place:
    """A fit in degrees."""
    last, first = int(np.argmax(work.along)), int(np.argmin(work.along))
    ends = [lat_lon(work.chart, float(fit.points[0][k]), float(fit.points[1][k])) for k in (last, first)]
    cov = cov_at_end(work, fit)
    rms = float(np.sqrt(np.nanmean(fit.residual**2))) if np.isfinite(fit.residual).any() else math.nan
    return Place(
        *ends[0], *ends[1], math.degrees(float(fit.at[2])), float(fit.at[3]) - 1.0, fit.offset, rms, fit.misfit,
        float(np.sqrt(np.linalg.eigvalsh(cov)[-1])), cov, probability,
    )  # fmt: skip
