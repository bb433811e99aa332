"""The plane that a route is drawn in: metres along the geodesic from start to end, and to its right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import wrap_longitude
from terranav.kernels.routing import barred
from terranav.maps.crs import Projection, projection

FloatArray = NDArray[np.float64]
Area = tuple[str, Sequence[FloatArray]]  # a name, and rings (n, 2) of latitude and longitude [deg]
Place = tuple[float, float]  # latitude and longitude [deg]

_LONGEST_SIDE_DEG = 0.25  # of a polygon: a longer one, straight in longitude and latitude, is bent in the plane


@dataclass(frozen=True)
class Plane:
    """Azimuthal equidistant about the middle of the geodesic, turned so that it runs along the first axis.

    Distances from the middle are true; others at a distance r from it are too long by at most about (r / R)^2 / 6, R
    the Earth's radius: 0.01 % for a route of 300 km.

    Attributes
    ----------
    middle_deg : latitude and longitude of the origin [deg]
    turned : float
        Direction of the first axis, clockwise from north at the middle [rad].
    length_m : float
        Of the geodesic.
    """

    middle_deg: Place
    turned: float
    length_m: float

    @classmethod
    def between(cls, start: Place, end: Place) -> Plane:
        """The plane of a start and an end."""
        at_start = _about(start)
        east, north = (float(value) for value in at_start.forward(*_arrays(end)))
        lat, lon = (float(value) for value in at_start.inverse(np.array(0.5 * east), np.array(0.5 * north)))
        middle = (lat, float(wrap_longitude(lon)))
        east, north = (float(value) for value in _about(middle).forward(*_arrays(end)))
        return cls(middle, math.atan2(east, north), 2.0 * math.hypot(east, north))

    @property
    def ends_m(self) -> tuple[FloatArray, FloatArray]:
        """Start and end (2,) in the plane [m]."""
        half = 0.5 * self.length_m
        return np.array([-half, 0.0]), np.array([half, 0.0])

    def to_plane(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """(n, 2) along and to the right [m] of positions (n,) [deg]."""
        east, north = _about(self.middle_deg).forward(lat_deg, lon_deg)
        cos, sin = math.cos(self.turned), math.sin(self.turned)
        return np.stack([north * cos + east * sin, east * cos - north * sin], axis=-1)

    def to_earth(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (n,) [deg] of points (n, 2) [m], the longitude within 180 of the middle's."""
        cos, sin = math.cos(self.turned), math.sin(self.turned)
        along, right = points_m[..., 0], points_m[..., 1]
        lat, lon = _about(self.middle_deg).inverse(along * sin + right * cos, along * cos - right * sin)
        return lat, self.middle_deg[1] + np.asarray(wrap_longitude(lon - self.middle_deg[1]))


@dataclass(frozen=True)
class Walls:
    """Keep-out areas in a plane.

    Attributes
    ----------
    sides : (m, 4) [m]
    owner : (m,)
        Number of each side's area.
    names : tuple of str
    """

    sides: FloatArray
    owner: NDArray[np.int64]
    names: tuple[str, ...]

    @classmethod
    def of(cls, areas: Sequence[Area], plane: Plane) -> Walls:
        """The areas' sides; those of one that is nowhere in the plane's reach do no harm."""
        sides, owner = [np.empty((0, 4))], [np.empty(0, dtype=np.int64)]
        for number, (_, rings) in enumerate(areas):
            for ring in rings:
                points = plane.to_plane(*_densified(ring).T)
                both = np.concatenate([points[:-1], points[1:]], axis=1)
                both = both[np.isfinite(both).all(axis=1)]
                sides.append(both)
                owner.append(np.full(len(both), number, dtype=np.int64))
        return cls(np.concatenate(sides), np.concatenate(owner), tuple(name for name, _ in areas))

    def hit(self, segments: FloatArray, margin_m: float) -> NDArray[np.int64]:
        """(n,) number of an area that segments (n, 4) come within `margin_m` of, -1 for none."""
        out = np.full(len(segments), -1, dtype=np.int64)
        if len(self.sides) and len(segments):
            barred(np.ascontiguousarray(segments), self.sides, self.owner, margin_m, out)
        return out

    def hit_track(self, points: FloatArray, margin_m: float) -> int:
        """Number of the first area that a polyline (n, 2) meets, -1 for none."""
        found = self.hit(np.concatenate([points[:-1], points[1:]], axis=1), margin_m)
        met = np.flatnonzero(found >= 0)
        return int(found[met[0]]) if met.size else -1


def _about(place: Place) -> Projection:
    """The azimuthal equidistant projection about a place."""
    return projection(f"+proj=aeqd +lat_0={place[0]!r} +lon_0={place[1]!r} +datum=WGS84 +units=m +type=crs")


def _arrays(place: Place) -> tuple[FloatArray, FloatArray]:
    return np.array(place[0]), np.array(place[1])


def _densified(ring: FloatArray) -> FloatArray:
    """A closed ring with sides of at most so many degrees, each taken the short way around the Earth."""
    step = np.diff(ring, axis=0)
    step[:, 1] = wrap_longitude(step[:, 1])
    pieces = np.maximum(np.ceil(np.abs(step).max(axis=1) / _LONGEST_SIDE_DEG), 1.0).astype(int)
    points = [
        start + away * (np.arange(n) / n)[:, None] for start, away, n in zip(ring[:-1], step, pieces, strict=True)
    ]
    return np.concatenate([*points, ring[-1:]])
