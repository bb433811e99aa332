"""The filter in the vehicle: what its INS is wrong by, from GNSS and from the fixes it is sent.

States (7): position error north, east [m], velocity error [m/s], acceleration error [m/s^2] (tilt and biases, forgotten
over 20 minutes for they turn with the vehicle), heading error [rad], which acts through the accelerations of turns:

    p' = v,   v' = a + psi (V_e', -V_n'),   a' = -a / T,   psi' = 0

A fix is compared with where the INS was at the time of the fix, so its age does not matter. As in PX4's filter it has a
noise floor of 0.9 m and a gate of 3 sigma per axis, and when everything was rejected for five seconds the position is
reset to the fix.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import GRAVITY_MPS2, offset_of
from terranav.core.ins_grade import InsGrade

FloatArray = NDArray[np.float64]

FLOOR_M, GATE_SIGMA, GIVE_IN_S = 0.9, 3.0, 5.0
#: a fix older than this is not taken [s]
OLDEST_S = 5.0
_FORGET_S, _SPEED_FLOOR_MPS = 1200.0, 0.05
_KEPT = 64  # positions of the INS, one a tick


@dataclass(frozen=True, slots=True)
class Fix:
    """A position from outside.

    Attributes
    ----------
    age_s : float
        How long ago it was so [s].
    lat_deg, lon_deg : float
    sigma_m : (north, east)
    velocity_mps : (north, east) or None
        With `velocity_sigma_mps`.
    velocity_sigma_mps : float
    reset : bool
        Set the position to it instead of weighing it.
    """

    age_s: float
    lat_deg: float
    lon_deg: float
    sigma_m: tuple[float, float]
    velocity_mps: tuple[float, float] | None = None
    velocity_sigma_mps: float = math.nan
    reset: bool = False


class Fusion:
    """Kalman filter of the INS's error.

    Parameters
    ----------
    grade : InsGrade
        What the vehicle knows of its INS.
    """

    def __init__(self, grade: InsGrade) -> None:
        accel = GRAVITY_MPS2 * math.hypot(math.radians(grade.attitude_sigma_deg), 1e-6 * grade.accel_bias_sigma_ug)
        sigma = (grade.position_sigma_m, grade.velocity_sigma_mps + 0.05, accel + 1e-4)
        spread = np.repeat(np.square(sigma), 2)
        self.mean = np.zeros(7)
        self.cov = np.diag([*spread, math.radians(grade.heading_sigma_deg) ** 2 + 1e-8])
        speed = math.hypot(grade.accel_walk_mps_per_sqrt_h / 60.0, grade.velocity_walk_mps_per_sqrt_s) + 1e-3
        self._noise = (grade.position_walk_m_per_sqrt_s**2, speed**2, 2.0 * spread[4] / _FORGET_S)
        self._grade_accel = float(spread[4])
        self._track: deque[tuple[float, float, float]] = deque(maxlen=_KEPT)
        self._velocity: tuple[float, float] | None = None
        self._refused_s = math.inf
        self.used = self.rejected = self.resets = 0

    def copy(self) -> Fusion:
        """Another filter in the same state."""
        other = Fusion.__new__(Fusion)
        other.__dict__.update(self.__dict__)
        other.mean, other.cov, other._track = self.mean.copy(), self.cov.copy(), self._track.copy()
        return other

    def predict(self, time_s: float, lat_deg: float, lon_deg: float, velocity_mps: tuple[float, float, float]) -> None:
        """Go on to what the INS indicates now."""
        if self._track:
            dt = time_s - self._track[-1][0]
            gained = (velocity_mps[0] - self._velocity[0], velocity_mps[1] - self._velocity[1])  # type: ignore[index]
            phi = np.eye(7)
            phi[0, 2] = phi[1, 3] = phi[2, 4] = phi[3, 5] = dt
            phi[4, 4] = phi[5, 5] = math.exp(-dt / _FORGET_S)
            phi[2, 6], phi[3, 6] = gained[1], -gained[0]
            self.mean = phi @ self.mean
            self.cov = phi @ self.cov @ phi.T
            self.cov[np.arange(6), np.arange(6)] += np.repeat(self._noise, 2) * dt
            self.cov[6, 6] += (2e-5) ** 2 * dt
        self._track.append((time_s, lat_deg, lon_deg))
        self._velocity = (velocity_mps[0], velocity_mps[1])

    def take(self, fix: Fix) -> bool:
        """Fuse a fix; False where it is too old, rejected, or no number."""
        values = (fix.age_s, fix.lat_deg, fix.lon_deg, *fix.sigma_m)
        if not all(map(math.isfinite, values)) or min(fix.sigma_m) <= 0.0 or not self._track:
            return False
        age = max(fix.age_s, 0.0)
        if age > OLDEST_S:
            return False
        off = offset_of(fix.lat_deg, fix.lon_deg, *self._place(self._track[-1][0] - age))
        sigma = np.maximum(fix.sigma_m, FLOOR_M)
        if fix.reset:
            return self._reset(off, sigma)
        h = np.zeros((2, 7))
        h[0, 0] = h[1, 1] = 1.0
        h[0, 2] = h[1, 3] = -age
        lack = np.array(off) - h @ self.mean
        s = h @ self.cov @ h.T + np.diag(sigma**2)
        if (lack**2 > GATE_SIGMA**2 * np.diag(s)).any():
            self.rejected += 1
            self._refused_s = min(self._refused_s, self._track[-1][0])
            return self._track[-1][0] - self._refused_s >= GIVE_IN_S and self._reset(off, sigma)
        self._update(h, lack, s, np.diag(sigma**2))
        if fix.velocity_mps is not None and self._velocity is not None:
            self._speed(self._velocity, fix.velocity_mps, fix.velocity_sigma_mps)
        self._refused_s = math.inf
        self.used += 1
        return True

    def _speed(self, indicated: tuple[float, float], told: tuple[float, float], sigma: float) -> None:
        """Fuse a velocity under the same gate, if it has an accuracy."""
        if not all(map(math.isfinite, (*told, sigma))) or sigma <= 0.0:
            return
        h = np.zeros((2, 7))
        h[0, 2] = h[1, 3] = 1.0
        lack = np.subtract(indicated, told) - h @ self.mean
        noise = max(sigma, _SPEED_FLOOR_MPS) ** 2 * np.eye(2)
        s = h @ self.cov @ h.T + noise
        if (lack**2 <= GATE_SIGMA**2 * np.diag(s)).all():
            self._update(h, lack, s, noise)

    def _update(self, h: FloatArray, lack: FloatArray, s: FloatArray, noise: FloatArray) -> None:
        """Kalman's update in Joseph's form."""
        gain = np.linalg.solve(s, h @ self.cov).T
        keep = np.eye(7) - gain @ h
        self.mean = self.mean + gain @ lack
        self.cov = keep @ self.cov @ keep.T + gain @ noise @ gain.T

    def _reset(self, off: tuple[float, float], sigma: FloatArray) -> bool:
        """Set the position error, and forget what it had to do with the other states."""
        self.mean[:2] = off
        self.cov[:2, :] = self.cov[:, :2] = 0.0
        self.cov[:2, :2] = np.diag(sigma**2)
        self._refused_s = math.inf
        self.resets += 1
        return True

    def _place(self, time_s: float) -> tuple[float, float]:
        """Where the INS said to be at a time, between two ticks by proportion; the oldest known before them."""
        later = self._track[-1]
        for earlier in reversed(self._track):
            if earlier[0] <= time_s:
                span = later[0] - earlier[0]
                share = (time_s - earlier[0]) / span if span > 0.0 else 0.0
                east = (later[2] - earlier[2] + 180.0) % 360.0 - 180.0
                return earlier[1] + share * (later[1] - earlier[1]), earlier[2] + share * east
            later = earlier
        return later[1], later[2]
