"""The vehicle's INS: the truth, and the errors of an INS of its grade that flies along.

The 13 error states of `terranav.ins.strapdown_error` (position, velocity, tilt and heading, gyro and accelerometer
biases) are drawn at the start and carried by the model's transition along the true flight, so that biases turn with the
vehicle and a heading error acts in turns. Nothing corrects them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import shifted
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch
from terranav.ins.strapdown_error import initial_covariance, transition
from terranav.kernels.strapdown import attitude_matrix
from terranav.live.testbed.aircraft import AircraftState, Triple

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Indicated:
    """What the INS says: position, horizontal velocity with the true vertical one, attitude."""

    lat_deg: float
    lon_deg: float
    velocity_mps: Triple
    attitude_deg: Triple


class Inertial:
    """An INS that drifts.

    Parameters
    ----------
    grade : InsGrade
    rng : Generator
    """

    def __init__(self, grade: InsGrade, rng: Generator) -> None:
        sigma = np.concatenate(
            [
                [grade.position_sigma_m] * 2,
                [grade.velocity_sigma_mps] * 2,
                np.sqrt(np.diag(initial_covariance(grade))),
            ]
        )
        self._grade, self._rng = grade, rng
        self.error = sigma * rng.standard_normal(13)
        self._before: Epoch | None = None

    def follow(self, time_s: float, truth: AircraftState) -> Indicated:
        """Carry the errors on to a time of the true flight, and say what the INS indicates there."""
        epoch = Epoch(time_s, truth.lat_deg, truth.lon_deg, truth.alt_m, truth.velocity_mps, truth.attitude_deg)
        if self._before is not None:
            phi, noise = transition(self._grade, self._before, epoch)
            # over a tick the noises hardly mix: their variances alone are drawn
            self.error = phi @ self.error + np.sqrt(np.diag(noise)) * self._rng.standard_normal(13)
        self._before = epoch
        north, east, v_north, v_east = self.error[:4].tolist()
        lat, lon = shifted(truth.lat_deg, truth.lon_deg, north, east)
        v = truth.velocity_mps
        return Indicated(lat, lon, (v[0] + v_north, v[1] + v_east, v[2]), self._attitude(truth.attitude_deg))

    def sensed(self, truth: AircraftState) -> tuple[FloatArray, FloatArray]:
        """Turn rates [rad/s] and specific force [m/s^2] in body axes (3,), as gyros and accelerometers with biases."""
        return np.array(truth.rates_radps) + self.error[7:10], np.array(truth.force_mps2) + self.error[10:13]

    def _attitude(self, true_deg: Triple) -> Triple:
        """Roll, pitch and heading of (1 - [phi x]) C [deg]."""
        c = attitude_matrix(*true_deg)
        n, e, d = self.error[4:7].tolist()
        tilted = c - np.array(((0.0, -d, e), (d, 0.0, -n), (-e, n, 0.0))) @ c
        pitch = -math.asin(min(max(float(tilted[2, 0]), -1.0), 1.0))
        roll = math.atan2(float(tilted[2, 1]), float(tilted[2, 2]))
        heading = math.atan2(float(tilted[1, 0]), float(tilted[0, 0]))
        return math.degrees(roll), math.degrees(pitch), math.degrees(heading) % 360.0
