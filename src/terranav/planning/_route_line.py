"""From corners to a line that can be flown: arcs of the turn radius, and corners moved to where they serve better."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Worth = tuple[float, float]  # the smaller the better, the first counting first

_ARC_STEP = math.radians(2.0)


def turns_of(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (n - 1,) of the legs, and by how much (n - 2,) the course turns between them, right positive [rad]."""
    leg = np.diff(corners, axis=0)
    course = np.arctan2(leg[:, 1], leg[:, 0])
    return np.hypot(*leg.T), (np.diff(course) + math.pi) % (2.0 * math.pi) - math.pi


def flyable(corners: FloatArray, radius_m: float) -> bool:
    """Whether the arcs of all corners fit on the legs between them."""
    legs, turns = turns_of(corners)
    if (np.abs(turns) > 0.9 * math.pi).any() or (legs <= 0.0).any():
        return False
    taken = np.concatenate([[0.0], radius_m * np.tan(0.5 * np.abs(turns)), [0.0]])
    return bool((taken[:-1] + taken[1:] <= legs * (1.0 + 1e-6)).all())


def plain(corners: FloatArray) -> FloatArray:
    """Without the corners at which nothing turns."""
    if len(corners) < 3:
        return corners
    _, turns = turns_of(corners)
    return np.asarray(corners[np.concatenate([[True], np.abs(turns) > 1e-6, [True]])])


def rounded(corners: FloatArray, radius_m: float) -> FloatArray:
    """(m, 2) polyline: the legs, with an arc of the radius tangent to both at every corner, in steps of 2 degrees."""
    _, turns = turns_of(corners)
    pieces = [corners[:1]]
    for i, turn in enumerate(turns.tolist()):
        corner = corners[i + 1]
        into = corner - corners[i]
        into = into / np.hypot(*into)
        right = np.array([-into[1], into[0]])
        taken = radius_m * math.tan(0.5 * abs(turn))
        angle = np.linspace(0.0, abs(turn), max(2, math.ceil(abs(turn) / _ARC_STEP) + 1))[:, None]
        side = math.copysign(1.0, turn) * right
        pieces.append(corner - taken * into + radius_m * (np.sin(angle) * into + (1.0 - np.cos(angle)) * side))
    return np.concatenate([*pieces, corners[-1:]])


def spaced(line: FloatArray, spacing_m: float) -> FloatArray:
    """(n, 2) points every so many metres along a polyline, and its end if it falls on one."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(int(way[-1] / spacing_m + 1e-9) + 1) * spacing_m
    return np.stack([np.interp(at, way, line[:, axis]) for axis in (0, 1)], axis=1)


def length_of(line: FloatArray) -> float:
    """Of a polyline [m]."""
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


@dataclass(frozen=True)
class Mending:
    """How corners are moved.

    Attributes
    ----------
    worth : callable
        Corners -> Worth; infinite first for what cannot be flown.
    step_m : float
        Of the first round; each later one has half of it.
    rounds : int
    """

    worth: Callable[[FloatArray], Worth]
    step_m: float
    rounds: int = 3

    def mended(self, corners: FloatArray) -> FloatArray:
        """Corners left out or moved one by one, as long as that makes the line better."""
        best = self.worth(corners)
        step = self.step_m
        for _ in range(self.rounds):
            corners, best = self._fewer(corners, best)
            i = 1
            while i < len(corners) - 1:
                for move in _compass(step):
                    tried = corners.copy()
                    tried[i] += move
                    worth = self.worth(tried)
                    if worth < best:
                        corners, best = tried, worth
                i += 1
            step *= 0.5
        return self._fewer(corners, best)[0]

    def _fewer(self, corners: FloatArray, best: Worth) -> tuple[FloatArray, Worth]:
        i = 1
        while i < len(corners) - 1:
            tried = np.delete(corners, i, axis=0)
            worth = self.worth(tried)
            if worth <= best:
                corners, best = tried, worth
            else:
                i += 1
        return corners, best


def _compass(step: float) -> FloatArray:
    """Eight moves, the four across and along first."""
    slant = step * math.sqrt(0.5)
    return np.array(
        [
            (0, step),
            (0, -step),
            (step, 0),
            (-step, 0),
            (slant, slant),
            (slant, -slant),
            (-slant, slant),
            (-slant, -slant),
        ],
        dtype=np.float64,
    )
