"""Rival places: would the readings since the fix fit elsewhere as well?

A posterior that has settled on one place says how well the readings fit there, not whether they would have fitted
elsewhere: particles that were lost, or a prior that left the truth out, are not in it. So from the moment of a fix,
rivals are kept on a lattice around the estimate, as far as the INS could be off, and move with it. Their likelihood
against the estimate's counts only readings that came after the fix and had no part in choosing it. The fix is believed
when all rivals together are less probable than the risk, where each starts with even odds: the estimate was chosen
among them for fitting well, so that it has no better claim. On flat land, and where the
ground repeats itself, that never happens, however certain the posterior is. This is the multiple-hypothesis test of
integrity monitoring (Blanch et al., Baseline advanced RAIM user algorithm, IEEE Trans. Aerospace and Electronic Systems
51, 2015, section III) with places for faults.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from terranav.core.frozen import changed
from terranav.core.kinds import KINDS
from terranav.core.records import Epoch, Measurement
from terranav.integrity.windows import CENTRE, PLACE, VALUE, Window
from terranav.kernels import integrity as kernels
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

SIDE = 71  # of the lattice, in places
CERTAIN = 14.0  # the probability of a rival sinks to exp(-14) of the risk and no further, so that it can come back
FADING = 0.97  # memory of what is recent: 33 readings
FITS = -4.0  # a rival with a better recent log ratio fits now, whatever it lost before
NEAR = 3.0  # rivals within so many spacings belong to the estimate's own surroundings
RANKED = 8  # one rival in so many is enough to rank the estimate among them


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one kind of reading says: each place's bias, their common variance, recent log ratios, and how many."""

    bias: FloatArray
    variance: float
    recent: FloatArray
    readings: int = 0


@dataclass(frozen=True, slots=True)
class Rivals:
    """Places around an estimate, the first the estimate itself.

    Attributes
    ----------
    spacing_m : float
    shift_m : (2, n) float64
        How far each has followed the slope of the map within its cell.
    odds : (n,) float64
        Log likelihood ratio against the estimate.
    evidence : tuple of (kind, Evidence)
    readings : int
        Weighed so far.
    proved : bool
        Whether the estimate has held against all rivals once.
    """

    spacing_m: float
    shift_m: FloatArray
    odds: FloatArray
    evidence: tuple[tuple[str, Evidence], ...] = ()
    readings: int = 0
    proved: bool = False

    @classmethod
    def within(cls, reach_m: float, finest_m: float) -> Rivals:
        """Rivals as far as `reach_m`, but not closer than `finest_m`."""
        n = len(_lattice()[1])
        spacing = max(reach_m / (SIDE // 2), finest_m)
        return cls(spacing, np.zeros((2, n)), np.zeros(n))

    @property
    def reach_m(self) -> float:
        """Distance of the farthest."""
        return self.spacing_m * (SIDE // 2)


@dataclass(frozen=True, slots=True)
class Standing:
    """How the rivals stand.

    Attributes
    ----------
    reach_m : float
        No more than the risk lies beyond [m].
    share : float
        Probability of all rivals outside the estimate's surroundings.
    best : float
        Log likelihood ratio of the likeliest against the estimate.
    best_m : (2,) float64
        Offset of its INS error from the estimate's [m].
    readings : int
        That have been weighed.
    """

    reach_m: float
    share: float
    best: float
    best_m: FloatArray
    readings: int


def weighed(
    rivals: Rivals,
    epoch: Epoch,
    reading: Measurement,
    chart: Map,
    centre_m: FloatArray,
    *,
    factor: float,
    budget: float,
) -> Rivals:
    """The rivals after one more reading.

    Parameters
    ----------
    rivals : Rivals
    epoch : Epoch
        Where the INS indicated to be.
    reading : Measurement
    chart : Map
    centre_m : (2,) the estimated INS error [m]
    factor : float
        How many times larger the noise is taken than told.
    budget : float
        Probability that is counted as refuted.
    """
    node = _lattice()[0] * rivals.spacing_m
    n = node.shape[1]
    before = dict(rivals.evidence).get(reading.kind)
    if before is None:
        sigma = KINDS[reading.kind].bias_sigma
        before = Evidence(np.zeros(n), (10.0 * sigma) ** 2 + chart.sigma**2, np.zeros(n))
    far = math.hypot(*centre_m.tolist()) + 1.5 * rivals.reach_m
    land = chart.around(epoch.lat_deg, epoch.lon_deg, max(far, chart.cell_m))
    frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, max(far, chart.cell_m))
    white = (factor * reading.sigma) ** 2
    out = np.empty((5, n))
    numbers = (
        reading.value, white, before.variance, rivals.spacing_m**2 / 12.0, rivals.spacing_m,
        math.log(budget) - CERTAIN, FADING,
    )  # fmt: skip
    kernels.weigh_rivals(
        land.values, np.array((frame.row, frame.col)), centre_m, node, rivals.shift_m, before.bias, rivals.odds,
        before.recent, np.array(numbers), out,
    )  # fmt: skip
    settled = before.variance * white / (before.variance + white)
    after = Evidence(out[2], settled + 0.5 * chart.sigma**2, out[4], before.readings + 1)
    others = tuple(pair for pair in rivals.evidence if pair[0] != reading.kind)
    return changed(
        rivals,
        shift_m=out[:2],
        odds=out[3],
        evidence=(*others, (reading.kind, after)),
        readings=rivals.readings + 1,
    )


def standing(rivals: Rivals, budget: float, near_m: float) -> Standing:
    """How the rivals stand; those nearer than `near_m` or three spacings are no rivals.

    What a rival lost while it was not yet in its place by the slope would refute it for good. So until the estimate has
    proved itself, the latest readings count alone for a rival that they fit; after that all count, and flat land does
    not make a proven fix doubtful.

    Parameters
    ----------
    rivals : Rivals
    budget : float
        Probability that may be left out.
    near_m : float [m]
    """
    nodes, distance = _lattice()
    near = max(near_m / rivals.spacing_m, NEAR)
    odds = rivals.odds
    if not rivals.proved:
        recent = np.sum([evidence.recent for _, evidence in rivals.evidence], axis=0) if rivals.evidence else 0.0
        odds = np.where(recent > FITS, np.maximum(odds, np.minimum(recent, 0.0)), odds)
    reach, share, best = kernels.reach_of_rivals(distance, odds, budget, near)
    return Standing(
        reach * rivals.spacing_m,
        share,
        float(odds[best]) if best else 0.0,
        nodes[:, best] * rivals.spacing_m,
        rivals.readings,
    )


def rank(rivals: Rivals, window: Window, chart: Map, readings: int) -> float:
    """Share of the rivals that the latest readings of a kind fit better than the estimate, whatever their noise.

    About one half where the estimate is as good as any other place, next to nothing where it is right.
    """
    rows = window.rows[-readings:]
    nodes, distance = _lattice()
    far = nodes.T[distance > NEAR][::RANKED] * rivals.spacing_m
    reach = 1.5 * rivals.reach_m + float(np.abs(rows[:, CENTRE]).max())
    lat_deg, lon_deg = rows[:, PLACE].T
    land = chart.around(lat_deg, lon_deg, max(reach, chart.cell_m))
    at = [land.local_frame(lat, lon, max(reach, chart.cell_m)) for lat, lon in rows[:, PLACE]]
    frames = np.array([(frame.row, frame.col) for frame in at])
    found = np.empty(1 + len(far))
    node = np.concatenate([np.zeros((1, 2)), far])
    kernels.scatter(
        land.values, frames, np.ascontiguousarray(rows[:, CENTRE]), np.ascontiguousarray(rows[:, VALUE]), node, found
    )
    known = found[1:][np.isfinite(found[1:])]
    return float(np.mean(known <= found[0])) if known.size and np.isfinite(found[0]) else 1.0


@lru_cache(maxsize=1)
def _lattice() -> tuple[FloatArray, FloatArray]:
    """Offsets (2, n) within a disc in spacings, and their distances, the centre first and rising from there."""
    at = np.arange(SIDE) - SIDE // 2
    north, east = (axis.ravel().astype(np.float64) for axis in np.meshgrid(at, at, indexing="ij"))
    inside = np.hypot(north, east) <= SIDE // 2 + 0.5
    nodes = np.stack([north[inside], east[inside]])
    distance = np.hypot(*nodes)
    rising = np.argsort(distance, kind="stable")
    return np.ascontiguousarray(nodes[:, rising]), distance[rising]
