"""A track of known shape and the heights under it: what `planning.locate` looks for on a map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_m
from terranav.core.errors import DataError
from terranav.core.kinds import kind_named
from terranav.core.records import Epoch
from terranav.sensors.ready import ready

FloatArray = NDArray[np.float64]

FEWEST_POINTS = 8  # of a profile
MOST_POINTS = 256  # of a profile; more are thinned out
STEP_CELLS = 0.75  # between two points that are kept


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
        if self.height.size < FEWEST_POINTS:
            raise DataError(f"the profile has {self.height.size} points, expected at least {FEWEST_POINTS}")
        if self.length_m <= 0.0:
            raise DataError("the profile has a length of 0 m, expected a track that moves")

    @classmethod
    def of(cls, epochs: Iterable[Epoch], kind: str, sigma: float | None = None) -> Track:
        """The readings of one kind along the indicated positions, of which only the shape is used.

        Parameters
        ----------
        epochs : iterable of Epoch, in the order of time
            Raw altimeter readings become terrain heights (`terranav.sensors.ready`).
        kind : str
            Map kind: 'terrain', 'bathymetry', 'gravity' or 'magnetic'.
        sigma : float, optional
            1-sigma of a reading, > 0 [unit of the kind]; by default the root mean square of what they say.

        Raises
        ------
        ConfigError
            There is no such kind, or sigma is out of its range.
        DataError
            Fewer than 8 readings of the kind, or a track without length.
        """
        kind_named(kind)
        rows = [
            (epoch.lat_deg, epoch.lon_deg, reading.value, reading.sigma)
            for epoch in ready(epochs)
            for reading in epoch.measurements
            if reading.kind == kind
        ]
        if len(rows) < FEWEST_POINTS:
            raise DataError(f"the profile has {len(rows)} {kind} readings, expected at least {FEWEST_POINTS}")
        lat, lon, value, told = np.array(rows).T
        middle = len(rows) // 2
        north, east = offset_m(lat[middle], lon[middle], lat, lon)
        return cls(north, east, value, float(np.sqrt(np.mean(told**2))) if sigma is None else sigma)

    @property
    def along_m(self) -> FloatArray:
        """(n,) way flown since the first point [m]."""
        steps = np.hypot(np.diff(self.north_m), np.diff(self.east_m))
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_m(self) -> float:
        """Length along the track [m]."""
        return float(np.hypot(np.diff(self.north_m), np.diff(self.east_m)).sum())


def thinned(track: Track, cell_m: float) -> NDArray[np.int64]:
    """Numbers of points about a cell apart at the least, and MOST_POINTS at the most."""
    along = track.along_m
    step = max(STEP_CELLS * cell_m, along[-1] / (MOST_POINTS - 1), 1e-9)
    wanted = np.searchsorted(along, np.arange(0.0, along[-1] - 0.5 * step, step)).clip(0, along.size - 1)
    wanted = np.unique(np.append(wanted, along.size - 1))  # the answer is where the last one is
    if wanted.size >= FEWEST_POINTS:
        return wanted
    return np.unique(np.linspace(0.0, along.size - 1.0, min(along.size, MOST_POINTS)).astype(np.int64))


def spread_order(height: FloatArray, along: FloatArray) -> NDArray[np.int64]:
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
