"""Terrain avoidance cueing: will the ground come too near along the next minutes, and which way is clear?

Papers/001 leaves it as future work: "advance terrain avoidance cueing (ATAC) technique can be implemented to signify
which path is better suited to deviate". At time t ahead the vehicle is at p(t) + d, where p is the dead-reckoned path
and d ~ N(0, P + (sigma_v t)^2 I), P being the covariance of the estimate. With h the map, z the altitude, m the margin:

    Pr(t) = E_d[ Phi((m - (z(t) - h(p(t) + d))) / sigma) ],   sigma^2 = sigma_altitude^2 + sigma_map^2

The expectation is Gauss-Hermite quadrature over the axes of the covariance, so it is deterministic. Where the map says
nothing the share of d that falls there is told apart as unknown: the probability then lies between Pr and Pr + unknown,
and a path is only called clear when the upper end stays within the threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, roots_hermitenorm

from terranav.core.checks import finite
from terranav.core.earth import GRAVITY_MPS2, shift
from terranav.core.errors import ConfigError
from terranav.core.records import Estimate, Status
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

MOST_STEPS = 1000  # along the look-ahead: ridges narrower than one such step may be missed
TURN_SPEED_MPS = 1.0  # below it there is no turn to speak of


class CueState(StrEnum):
    """What a path is worth."""

    CLEAR = "clear"  # the probability is known to stay within the threshold
    WARNING = "warning"  # it is known to exceed it
    UNKNOWN = "unknown"  # the map does not say, or the estimate calls itself lost


@dataclass(frozen=True)
class CueSettings:
    """How far to look, and what is too near.

    Attributes
    ----------
    margin_m : float
        Least clearance above ground, >= 0 [m].
    lookahead_s : float
        How far ahead, > 0 [s].
    threshold : float
        Probability of less clearance that is a warning, in (0, 1).
    altitude_sigma_m : float
        1-sigma of the altitude [m].
    velocity_sigma_mps : float
        1-sigma of the horizontal velocity per axis, by which the position spreads on the way ahead [m/s].
    bank_deg : float
        Bank of an evasive turn, in (0, 80] [deg].
    turns_deg : tuple of float
        Heading changes to try on either side, in (0, 180] [deg].
    nodes : int
        Quadrature nodes on each axis, 3 to 51; eleven reach 5 sigma.

    Raises
    ------
    ConfigError
        For a value out of its range.
    """

    margin_m: float = 150.0
    lookahead_s: float = 120.0
    threshold: float = 0.01
    altitude_sigma_m: float = 5.0
    velocity_sigma_mps: float = 0.5
    bank_deg: float = 30.0
    turns_deg: tuple[float, ...] = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 150.0, 180.0)
    nodes: int = 11

    def __post_init__(self) -> None:
        finite("cue margin_m", self.margin_m, minimum=0.0)
        finite("cue lookahead_s", self.lookahead_s, above=0.0)
        finite("cue threshold", self.threshold, above=0.0, maximum=0.999)
        finite("cue altitude_sigma_m", self.altitude_sigma_m, minimum=0.0)
        finite("cue velocity_sigma_mps", self.velocity_sigma_mps, minimum=0.0)
        finite("cue bank_deg", self.bank_deg, above=0.0, maximum=80.0)
        for turn in self.turns_deg:
            finite("cue turns_deg", turn, above=0.0, maximum=180.0)
        if isinstance(self.nodes, bool) or not isinstance(self.nodes, int) or not 3 <= self.nodes <= 51:
            raise ConfigError(f"cue nodes is {self.nodes!r}, expected a whole number from 3 to 51")


@dataclass(frozen=True)
class Cue:
    """What lies ahead of one estimate.

    Attributes
    ----------
    state : CueState
        Of the present path.
    ahead_s : (n,) times ahead, from 0 [s]
    probability : (n,)
        That clearance is below the margin, as far as the map knows; NaN where it says nothing at all.
    unknown : (n,)
        Probability of being where the map says nothing.
    time_to_s : float
        First time ahead at which the probability exceeds the threshold [s], NaN if it does not.
    unknown_from_s : float
        First time ahead at which the map no longer rules that out [s], NaN if it always does.
    left_deg, right_deg : float
        Smallest heading change tried to that side that is known to be clear [deg]; 0 on a path that is clear already,
        NaN where none is known to be.
    climb_mps : float
        Least steady rate of climb, heading kept, that is known to be clear [m/s, up]; 0 where level flight is, NaN
        where none is known to be.
    """

    state: CueState
    ahead_s: FloatArray
    probability: FloatArray
    unknown: FloatArray
    time_to_s: float
    unknown_from_s: float
    left_deg: float
    right_deg: float
    climb_mps: float

    @property
    def peak(self) -> float:
        """Largest probability along the path, NaN where nothing is known."""
        known = self.probability[np.isfinite(self.probability)]
        return float(known.max()) if known.size else math.nan


@dataclass(frozen=True)
class _Scene:
    """Everything a path is judged by."""

    estimate: Estimate
    chart: Map
    settings: CueSettings
    velocity: FloatArray  # (3,) north, east, down [m/s]

    @property
    def speed_mps(self) -> float:
        return float(math.hypot(self.velocity[0], self.velocity[1]))

    @property
    def sigma_m(self) -> float:
        """1-sigma of clearance at a known place."""
        return math.hypot(self.settings.altitude_sigma_m, self.chart.sigma)

    def times(self) -> FloatArray:
        """(n,) times ahead, at least two a cell."""
        finest = 0.5 * self.chart.cell_m / max(self.speed_mps, 1e-9)
        steps = math.ceil(self.settings.lookahead_s / min(finest, 1.0, self.settings.lookahead_s))
        return np.linspace(0.0, self.settings.lookahead_s, min(steps, MOST_STEPS) + 1)

    def ground(self, ahead_s: FloatArray, turn_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Heights (n, k) at the nodes about the path at those times, NaN where unknown, and the nodes' weights (k,)."""
        node, weight = roots_hermitenorm(self.settings.nodes)
        weight = weight / weight.sum()
        u, v = (axis.ravel() for axis in np.meshgrid(node, node, indexing="ij"))
        variance, axes = np.linalg.eigh(self.estimate.cov_m2)
        grown = np.maximum(variance, 0.0) + (self.settings.velocity_sigma_mps * ahead_s[:, None]) ** 2
        spread = np.sqrt(grown)  # (n, 2) along the axes
        along, across = spread[:, :1] * u, spread[:, 1:] * v
        path = self.path(ahead_s, turn_deg)
        north = path[:, :1] + axes[0, 0] * along + axes[0, 1] * across
        east = path[:, 1:] + axes[1, 0] * along + axes[1, 1] * across
        place = shift(self.estimate.lat_deg, self.estimate.lon_deg, north, east)
        return self.chart.sample(*place), np.outer(weight, weight).ravel()

    def path(self, ahead_s: FloatArray, turn_deg: float) -> FloatArray:
        """(n, 2) metres north and east after those times: a level turn (right is positive), then straight."""
        straight = ahead_s[:, None] * self.velocity[:2]
        if turn_deg == 0.0:
            return straight
        speed, heading = self.speed_mps, math.atan2(self.velocity[1], self.velocity[0])
        rate = math.copysign(GRAVITY_MPS2 * math.tan(math.radians(self.settings.bank_deg)) / speed, turn_deg)
        turning = np.minimum(ahead_s, math.radians(turn_deg) / rate)
        now = heading + rate * turning
        after = speed * (ahead_s - turning)
        north = speed / rate * (np.sin(now) - math.sin(heading)) + after * np.cos(now)
        east = speed / rate * (math.cos(heading) - np.cos(now)) + after * np.sin(now)
        return np.stack([north, east], axis=1)

    def below(self, height_m: FloatArray, altitude_m: FloatArray) -> FloatArray:
        """Probability (n, k) of less clearance than the margin above ground of known height, 0 where unknown."""
        short = self.settings.margin_m - (altitude_m - height_m)
        chance = ndtr(short / self.sigma_m) if self.sigma_m > 0.0 else (short > 0.0).astype(np.float64)
        return np.where(np.isnan(height_m), 0.0, chance)

    def risk(self, ahead_s: FloatArray, turn_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Known and unknown probability (n,) of too little clearance along a path, vertical speed kept."""
        height, weight = self.ground(ahead_s, turn_deg)
        altitude = self.estimate.alt_m - self.velocity[2] * ahead_s
        return self.below(height, altitude[:, None]) @ weight, _unknown(height, weight)

    def state(self, known: FloatArray, unknown: FloatArray) -> CueState:
        """What a path with these probabilities is worth."""
        if (known > self.settings.threshold).any():
            return CueState.WARNING
        doubtful = (known + unknown > self.settings.threshold).any() or self.estimate.status is Status.LOST
        return CueState.UNKNOWN if doubtful else CueState.CLEAR


def cue(
    estimate: Estimate,
    velocity_mps: tuple[float, float, float],
    chart: Map,
    settings: CueSettings | None = None,
    *,
    evade: bool = True,
) -> Cue:
    """Look ahead from an estimate.

    Parameters
    ----------
    estimate : Estimate
        Its position, covariance and altitude (in the map's vertical datum).
    velocity_mps : (north, east, down) [m/s]
        Kept over the look-ahead.
    chart : Map
        Of terrain or bathymetry.
    settings : CueSettings, optional
    evade : bool
        Whether to look for turns and climbs; without, the three of them are NaN.

    Returns
    -------
    Cue

    Raises
    ------
    ConfigError
        For a map of another kind, or a velocity or altitude that is not finite.
    """
    settings = settings or CueSettings()
    if chart.kind not in ("terrain", "bathymetry"):
        raise ConfigError(f"{chart.name}: map of kind {chart.kind}, expected terrain or bathymetry to keep clear of")
    velocity = np.array([finite("cue velocity_mps", value) for value in velocity_mps])
    if velocity.shape != (3,):
        raise ConfigError(f"cue velocity_mps is {velocity_mps!r}, expected three numbers (north, east, down)")
    finite("cue estimate alt_m", estimate.alt_m)
    scene = _Scene(estimate, chart, settings, velocity)
    ahead = scene.times()
    known, unknown = scene.risk(ahead)
    state = scene.state(known, unknown)
    found = Cue(
        state,
        ahead,
        np.where(unknown < 1.0, known, np.nan),
        unknown,
        _first_time(scene, ahead, known, upper=False),
        _first_time(scene, ahead, known + unknown, upper=True),
        *(math.nan, math.nan, math.nan),
    )
    if not evade:
        return found
    left, right = (_least_turn(scene, ahead, side, state) for side in (-1.0, 1.0))
    return replace(found, left_deg=left, right_deg=right, climb_mps=_least_climb(scene, ahead))


def _unknown(height_m: FloatArray, weight: FloatArray) -> FloatArray:
    """Share (n,) of the nodes that have no height; exactly 1 where none has one, whatever the weights round to."""
    missing = np.isnan(height_m)
    return np.where(missing.all(axis=1), 1.0, missing @ weight)


def _first_time(scene: _Scene, ahead_s: FloatArray, chance: FloatArray, *, upper: bool) -> float:
    """When a probability first exceeds the threshold, to a microsecond; NaN if never."""
    over = np.flatnonzero(chance > scene.settings.threshold)
    if not over.size:
        return math.nan
    first = int(over[0])
    low, high = float(ahead_s[max(first - 1, 0)]), float(ahead_s[first])
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        known, unknown = scene.risk(np.array([middle]))
        value = float(known[0] + unknown[0]) if upper else float(known[0])
        low, high = (low, middle) if value > scene.settings.threshold else (middle, high)
    return high


def _least_turn(scene: _Scene, ahead_s: FloatArray, side: float, straight: CueState) -> float:
    """Smallest heading change to one side (-1 left, 1 right) that is clear [deg]."""
    if straight is CueState.CLEAR:
        return 0.0
    if scene.speed_mps < TURN_SPEED_MPS:
        return math.nan
    for turn in sorted(scene.settings.turns_deg):
        if scene.state(*scene.risk(ahead_s, side * turn)) is CueState.CLEAR:
            return turn
    return math.nan


def _least_climb(scene: _Scene, ahead_s: FloatArray) -> float:
    """Least steady rate of climb that keeps the present heading clear [m/s]; see `Cue.climb_mps`."""
    height, weight = scene.ground(ahead_s)
    unknown = _unknown(height, weight)
    allowed = scene.settings.threshold - unknown
    if (allowed <= 0.0).any() or scene.estimate.status is Status.LOST:
        return math.nan

    def over(altitude_m: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(scene.below(height, altitude_m[:, None]) @ weight > allowed)

    now = np.full(ahead_s.size, scene.estimate.alt_m)
    if over(now)[0]:
        return math.nan  # too near already: no rate of climb is quick enough
    low, high = now, np.maximum(now, np.nanmax(height, axis=1) + scene.settings.margin_m + 10.0 * scene.sigma_m)
    if not over(low).any():
        return 0.0
    while float((high - low).max()) > 1e-6:
        middle = 0.5 * (low + high)
        too_low = over(middle)
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    needed = np.where(over(now), high - now, 0.0)
    return float((needed[1:] / ahead_s[1:]).max())
