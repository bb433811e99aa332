"""Where on a whole map was this profile flown? No prior position; the answer comes with a proof.

A track of known shape (metres north and east, as indicated over a minute or more) and the heights under it are placed
anywhere on a map, turned by a small unknown heading and lifted by an unknown height offset. Blocks of placements are
left out when a lower bound of their misfit exceeds that of the best by a margin (`kernels.locating`), from blocks of 64
cells down to one cell and a heading step that moves the track's ends by half a cell. The bound holds for every
position between the cells and every heading between the steps, so nothing better than the margin is skipped. What
remains is fitted below the cell by least squares, and weighed by its likelihood times its volume (Laplace).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, DataError
from terranav.maps.map import Map
from terranav.planning._placements import SWEEP, TOP, Fit, Search, fitted, lat_lon, searched, tables_of

FloatArray = NDArray[np.float64]

FIRST_FITS, MOST_FITS = 8, 60  # places fitted below the cell: for a first limit, and at last
MOST_POINTS = 256  # of a profile; more are thinned out
PARTS = (0.3, 0.6)  # of the misfit that is usual at most, tried first: a low limit is soon searched
MOST_SIGMA_CELLS = 0.75  # of a place that counts as known: within two cells at 99 %
SCALES = (1.0, 3.0, 10.0, 30.0, 100.0)  # by which the variances grow until some place fits


@dataclass(frozen=True)
class Track:
    """What was flown and what was seen.

    Attributes
    ----------
    north_m, east_m : (n,) float64, n >= 8
        Positions relative to anything fixed, such as the first indicated one [m].
    height : (n,) float64
        Heights of the terrain under them, up to one common offset [unit of the map].
    sigma : float
        1-sigma of a height without the map's part, > 0 [unit of the map].

    Raises
    ------
    DataError, ConfigError
        For arrays of other shapes, numbers that are not finite, a track without length.
    """

    north_m: FloatArray
    east_m: FloatArray
    height: FloatArray
    sigma: float

    def __post_init__(self) -> None:
        finite("sigma", self.sigma, above=0.0)
        for name in ("north_m", "east_m", "height"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.ndim != 1 or array.size != np.size(self.height):
                raise DataError(f"{name} has shape {array.shape}, expected ({np.size(self.height)},) as height")
            if not np.isfinite(array).all():
                raise DataError(f"{name} holds {array[~np.isfinite(array)][0]}, expected finite numbers")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.height.size < 8:
            raise DataError(f"the profile has {self.height.size} points, expected at least 8")
        if self.length_m <= 0.0:
            raise DataError("the profile has a length of 0 m, expected a track that moves")

    @property
    def length_m(self) -> float:
        """Length along the track [m]."""
        return float(np.hypot(np.diff(self.north_m), np.diff(self.east_m)).sum())


@dataclass(frozen=True)
class LocateSettings:
    """How wide to search, and what is certain.

    Attributes
    ----------
    heading_deg : float
        Largest heading error either way, in [0, 180] [deg]; the time grows with it.
    offset_sigma : float
        1-sigma of the common height offset, > 0, by default unknown [unit of the map].
    certain : float
        Probability of the best place below which the answer is ambiguous, in (0, 1).
    tail : float
        Share of the probability that may lie in what was left out, in (0, 1); what it came to is reported.
    most_places : int
        Cells times headings that may be kept; where more fit, the search stops and the answer is ambiguous.

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

    def __post_init__(self) -> None:
        finite("heading_deg", self.heading_deg, minimum=0.0, maximum=180.0)
        if self.offset_sigma != math.inf:
            finite("offset_sigma", self.offset_sigma, above=0.0)
        for name in ("certain", "tail"):
            if finite(name, getattr(self, name), above=0.0) >= 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)!r}, expected a number between 0 and 1")
        finite("most_places", self.most_places, minimum=1)


@dataclass(frozen=True)
class Place:
    """One placement of the track.

    Attributes
    ----------
    lat_deg, lon_deg, first_lat_deg, first_lon_deg : float
        Of the track's last and first point [deg].
    heading_deg : float
        By which the track is to be turned clockwise [deg].
    offset, rms : float
        Heights given less the map's, and what remains after it [unit of the map].
    misfit : float
        Sum of squares over variances; about the number of points where the place is right.
    sigma_m : float
        1-sigma of the position along its worse axis, the candidate being the right one [m].
    probability : float
        Among the candidates; see `Located.complete` and `tail` for what may lie outside them.
    """

    lat_deg: float
    lon_deg: float
    first_lat_deg: float
    first_lon_deg: float
    heading_deg: float
    offset: float
    rms: float
    misfit: float
    sigma_m: float
    probability: float


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
    scale : float
        By which the variances had to grow until some place fitted.
    blocks, lookups : int
        Blocks bounded, and points looked up for that.
    share : float
        Those lookups over what all cells, heading steps and points would have taken.
    """

    candidates: tuple[Place, ...]
    ambiguous: bool
    reasons: tuple[str, ...]
    complete: bool
    margin: float
    tail: float
    scale: float
    blocks: int
    lookups: int
    share: float


def locate(track: Track, chart: Map, settings: LocateSettings | None = None) -> Located:
    """Find a profile anywhere on a map.

    Parameters
    ----------
    track : Track
        The whole of it must lie on the map; voids are allowed at a cost.
    chart : Map
    settings : LocateSettings, optional

    Returns
    -------
    Located

    Raises
    ------
    DataError
        The track is longer than the map is wide.
    """
    settings = settings or LocateSettings()
    work = _prepared(track, chart, settings)
    margin, usual = _margin(chart, settings.tail), float(chi2.ppf(0.9999, work.height.size))
    most, fits = settings.most_places, list[Fit]()
    for scale, part in [(1.0, part) for part in PARTS] + [(scale, 1.0) for scale in SCALES]:
        weight = work.weight / scale  # first some place that fits, then all that are within the margin of it
        kept, _, complete = searched(work, weight, part * usual, 0.0, most)
        fits, left = fitted(work, weight, kept, margin, FIRST_FITS)
        if fits and fits[0].misfit <= usual:
            kept, limit, complete = searched(work, weight, fits[0].misfit + margin, margin, most)
            fits, left = fitted(work, weight, kept, margin, MOST_FITS)
            margin = max(limit - fits[0].misfit, 0.0)
            break
        if not complete:
            break
    return _judged(work, fits, settings, (margin, scale, complete, left))


def _margin(chart: Map, tail: float) -> float:
    """Misfit above the best that leaves at most a share `tail` outside, the best place filling 1e-5 of its leaf."""
    return 2.0 * math.log(chart.values.size * 1e5 / tail)


def _thinned(track: Track, cell_m: float) -> NDArray[np.int64]:
    """Numbers of points about a cell apart at the least, and MOST_POINTS at the most."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(track.north_m), np.diff(track.east_m)))])
    step = max(0.75 * cell_m, along[-1] / (MOST_POINTS - 1), 1e-9)
    wanted = np.unique(np.searchsorted(along, np.arange(0.0, along[-1] + 0.5 * step, step)).clip(0, along.size - 1))
    return wanted if wanted.size >= 8 else np.arange(along.size)


def _ordered(height: FloatArray, along: FloatArray) -> NDArray[np.int64]:
    """An order in which few points exclude much: each the farthest from all before, in height and along the track."""
    y = (height - height.mean()) / max(float(height.std()), 1e-9)
    x = 2.0 * along / max(float(along[-1]), 1e-9)
    order = [int(np.argmax(np.abs(y)))]
    apart = np.full(height.size, np.inf)
    while len(order) < height.size:
        last = order[-1]
        apart = np.minimum(apart, (y - y[last]) ** 2 + (x - x[last]) ** 2)
        apart[last] = -1.0
        order.append(int(np.argmax(apart)))
    return np.array(order)


def _prepared(track: Track, chart: Map, settings: LocateSettings) -> Search:
    """The profile thinned and ordered, and the tables of the map."""
    chosen = _thinned(track, chart.cell_m)
    north, east, height = track.north_m[chosen], track.east_m[chosen], track.height[chosen]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(north), np.diff(east)))])
    # the map's error is correlated along the track: its part of the variance counts as often as it repeats
    repeats = float(np.exp(-np.abs(along[:, None] - along) / chart.error_length_m).sum(axis=1).mean())
    variance = track.sigma**2 + repeats * chart.sigma**2
    middle = 0.5 * (north.min() + north.max()), 0.5 * (east.min() + east.max())
    order = _ordered(height, along)
    down, right = (north - middle[0])[order], (east - middle[1])[order]
    reach = float(np.hypot(down, right).max()) / chart.cell_m
    if reach > math.hypot(*chart.shape):
        raise DataError(f"the track reaches {2 * reach:.0f} cells, expected less than the map {chart.name} is wide")
    spread = float(np.nanvar(chart.values.astype(np.float64)))
    half = math.radians(settings.heading_deg)
    counts = [2 ** math.ceil(math.log2(max(half * reach / (SWEEP * 2**level), 1.0))) for level in range(TOP + 1)]
    begins = np.concatenate([[0], np.cumsum(counts)[:-1]])
    lows, highs, spans = tables_of(chart.values)
    return Search(
        chart, down, right, along[order], height[order], np.full(order.size, 1.0 / variance),
        settings.offset_sigma**-2.0,
        1.0 + math.log1p(spread / variance), half, lows, highs, spans, np.column_stack([begins, counts]),
    )  # fmt: skip


def _judged(work: Search, fits: list[Fit], settings: LocateSettings, found: tuple[float, float, bool, int]) -> Located:
    """Probabilities, and whether they allow an answer."""
    margin, scale, complete, left = found
    mass = np.array([math.exp(-0.5 * (fit.misfit - fits[0].misfit)) * fit.volume for fit in fits])
    share = mass / mass.sum() if len(fits) else mass
    order = np.argsort(-share, kind="stable")
    places = tuple(_place(work, fits[k], float(share[k])) for k in order)
    whole = work.chart.values.size * max(2.0 * work.half, 1.0 if work.half == 0.0 else 0.0)
    tail = whole * math.exp(-0.5 * margin) / max(float(mass.sum()), 1e-300) if fits and complete else 1.0
    reasons = []
    if not complete:
        reasons.append(f"more than {settings.most_places} cells and headings fit: too little relief to search all")
    if left:
        reasons.append(f"{left} cells and headings fit that were not looked at closer")
    if not places:
        reasons.append("no place on the map fits")
    elif places[0].probability < settings.certain:
        reasons.append(f"the best place has a probability of {places[0].probability:.3f} among {len(places)} places")
    if places and places[0].sigma_m > MOST_SIGMA_CELLS * work.chart.cell_m:
        reasons.append(f"the best place is known to {places[0].sigma_m:.0f} m (1-sigma) along one axis alone")
    if scale > 1.0 and places:
        reasons.append(f"no place fits unless the variances are {scale:g} times as large")
    return Located(
        places, bool(reasons), tuple(reasons), complete, margin, min(tail, 1.0), scale,
        int(work.counts[1]), int(work.counts[2]), float(work.counts[2]) / work.lookups_of_all,
    )  # fmt: skip


def _place(work: Search, fit: Fit, probability: float) -> Place:
    """A fit in degrees."""
    last, first = int(np.argmax(work.along)), int(np.argmin(work.along))
    ends = [lat_lon(work.chart, float(fit.points[0][k]), float(fit.points[1][k])) for k in (last, first)]
    rms = float(np.sqrt(np.nanmean(fit.residual**2)))
    return Place(
        *ends[0],
        *ends[1],
        math.degrees(fit.psi),
        fit.offset,
        rms,
        fit.misfit,
        fit.sigma * work.chart.cell_m,
        probability,
    )
