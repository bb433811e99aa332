"""The plane around a pole on which maps are drawn that latitude and longitude would tear apart."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from terranav.app.mapping import meridian, parallel
from terranav.app.style import nice_length
from terranav.app.trackmap import HALO, scale_bar
from terranav.core.earth import metres_per_degree

if TYPE_CHECKING:
    from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Box = tuple[float, float, float, float]

LOWEST_LAT_DEG = 55.0  # a map that comes farther from the pole stays on latitude and longitude
_PROBES = 201


@dataclass(frozen=True)
class Polar:
    """Degrees of latitude from a pole, in the direction of the longitude: azimuthal, meridians true to scale.

    Attributes
    ----------
    pole_deg : float
        Latitude of the pole, 90 or -90.
    turn_deg : float
        The longitude that points down from the North Pole, up from the South Pole: north is up along it.
    """

    pole_deg: float
    turn_deg: float

    @property
    def sign(self) -> float:
        """1 for the North Pole, -1 for the South Pole."""
        return math.copysign(1.0, self.pole_deg)

    def plane(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(right, up) of places [deg]."""
        away = 90.0 - self.sign * np.asarray(lat_deg, dtype=np.float64)
        angle = np.radians(np.asarray(lon_deg, dtype=np.float64) - self.turn_deg)
        return away * np.sin(angle), -self.sign * away * np.cos(angle)

    def earth(self, right: ArrayLike, up: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude of places of the plane [deg]."""
        x, y = np.asarray(right, dtype=np.float64), np.asarray(up, dtype=np.float64)
        angle = np.degrees(np.arctan2(x, -self.sign * y))
        return self.sign * (90.0 - np.hypot(x, y)), (angle + self.turn_deg + 180.0) % 360.0 - 180.0

    def metres_per_degree(self, box: Box) -> float:
        """Along a meridian in the middle of a box of the plane [m]."""
        low, left, high, right = box
        lat, _ = self.earth(0.5 * (left + right), 0.5 * (low + high))
        return float(metres_per_degree(lat)[0])


def polar_plane(chart: Map) -> Polar | None:
    """The plane for a map near a pole, None where latitude and longitude do."""
    south, west, north, east = chart.bounds_deg
    if max(south, -north) < LOWEST_LAT_DEG:
        return None
    pole = 90.0 if south > 0.0 else -90.0
    near, far = (abs(lat) for lat in ((north, south) if pole > 0.0 else (south, north)))
    around = east - west >= 180.0
    narrows = math.cos(math.radians(min(near, 90.0))) < 0.5 * math.cos(math.radians(far))
    if not around and not (narrows and east - west > 20.0):
        return None
    if not around:
        return Polar(pole, 0.5 * (west + east))
    lons = np.arange(-180.0, 180.0)
    rows, _ = chart.cells(math.copysign(89.99, pole), lons)  # as the map's own rows lie
    level = not np.isfinite(rows).all() or float(np.ptp(rows)) < 1e-6
    return Polar(pole, 0.0 if level else float(lons[rows.argmax() if pole > 0.0 else rows.argmin()]))


def hull(chart: Map, polar: Polar) -> Box:
    """Low, left, high, right of a map on the plane [deg]."""
    south, _, north, _ = chart.bounds_deg
    reach = 90.0 - min(abs(south), abs(north))
    low, left, high, right = -reach, -reach, reach, reach
    for _ in range(4):
        x, y = np.linspace(left, right, _PROBES), np.linspace(low, high, _PROBES)
        there: NDArray[np.bool_] = chart.covers(*polar.earth(x[None, :], y[:, None]))
        if not there.any():
            break
        over, up = np.flatnonzero(there.any(axis=0)), np.flatnonzero(there.any(axis=1))
        dx, dy = x[1] - x[0], y[1] - y[0]
        left, right = max(left, x[over[0]] - dx), min(right, x[over[-1]] + dx)
        low, high = max(low, y[up[0]] - dy), min(high, y[up[-1]] + dy)
    return float(low), float(left), float(high), float(right)


def dress_polar(axes: Axes, box: Box, polar: Polar) -> None:
    """Parallels and meridians with their names, equal scales, and a scale bar."""
    low, left, high, right = box
    axes.set_aspect(1.0)
    axes.grid(visible=False)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(True)
    corners = np.hypot(*np.meshgrid([left, right], [low, high]))
    inside = left < 0.0 < right and low < 0.0 < high
    nearest = 0.0 if inside else math.hypot(max(left, 0.0, -right), max(low, 0.0, -high))
    step = nice_length((float(corners.max()) - nearest) / 4.0)
    line: dict[str, Any] = {"color": "#1b232b", "linewidth": 0.6, "alpha": 0.5}
    toward = math.atan2(0.5 * (left + right), -polar.sign * 0.5 * (low + high))
    between = 30.0 * math.floor((polar.turn_deg + 75.0) / 30.0) + 15.0  # two meridians that have names
    at = math.radians(between - polar.turn_deg) if inside else toward
    turn = np.linspace(0.0, 2.0 * np.pi, 721)
    digits = max(0, math.ceil(-math.log10(step) - 1e-9))
    for k in range(max(math.floor(nearest / step), 1), math.ceil(float(corners.max()) / step)):
        axes.plot(k * step * np.sin(turn), k * step * np.cos(turn), **line)
        x, y = k * step * math.sin(at), -polar.sign * k * step * math.cos(at)
        name = parallel(polar.sign * (90.0 - k * step), digits)
        _name(axes, box, (x, y), name)
    wide = 0.5 * (right - left) / max(0.5 * (nearest + float(corners.max())), 1e-9)
    every = next(size for size in (1, 2, 5, 10, 15, 30) if size >= 30 or math.degrees(wide) / size < 4.0)
    for lon in range(-180, 180, every):
        x, y = (float(value) for value in polar.plane(0.0, lon))
        axes.plot([0.0, x], [0.0, y], **line)
        end = _last(box, x, y)
        if end is not None and (lon % 30 == 0 or not inside):
            _name(axes, box, end, meridian(lon, 0))
    axes.set(xlim=(left, right), ylim=(low, high))
    scale_bar(axes, box, polar.metres_per_degree(box))


def _name(axes: Axes, box: Box, place: tuple[float, float], text: str) -> None:
    """A label, where it fits."""
    low, left, high, right = box
    across, over = (place[0] - left) / (right - left), (place[1] - low) / (high - low)
    in_corner = across < 0.34 and over < 0.12  # the scale bar is there
    if 0.03 < across < 0.97 and 0.02 < over < 0.98 and not in_corner:
        axes.annotate(text, place, ha="center", va="center", fontsize=8.5, path_effects=HALO, zorder=8)


def _last(box: Box, x: float, y: float) -> tuple[float, float] | None:
    """Where the way from the pole to (x, y) is last in a box, a little within it; None where it misses it."""
    low, left, high, right = box
    share = np.linspace(0.0, 1.0, 4001)
    margin = 0.04
    wide, tall = margin * (right - left), margin * (high - low)
    there = (
        (share * x > left + wide) & (share * x < right - wide) & (share * y > low + tall) & (share * y < high - tall)
    )
    if not there.any():
        return None
    last = float(share[there.nonzero()[0][-1]])
    return last * x, last * y
