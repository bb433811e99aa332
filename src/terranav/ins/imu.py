"""A strapdown INS from the inertial sensors that a vehicle logged, and their biases while its motion is known.

Readings at any rate are integrated (trapezoid) and taken off the integral at even steps, so jitter and short gaps of
the log's clock cost nothing; then the strapdown integration of `terranav.ins.strapdown`, the height held by the
barometer.

Biases, over a stretch where attitude C (body to north-east-down) and velocity v are known, from the means of

    gyro  - rotation of C over a step / dt - C' (rate of the Earth)
    accel - C' (dv/dt - g)

They are what the sensors show in this very installation, tilt of the logged attitude included: it cancels them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terranav.core.earth import GRAVITY_MPS2, wrap_longitude
from terranav.core.errors import DataError
from terranav.ins.strapdown import _GYRO, _HOLD_S, _integrated
from terranav.ins.trajectory import Trajectory

FloatArray = NDArray[np.float64]

STEP_S = 0.02  # of the integration
SLOWEST_HZ = 20.0  # slower readings miss the vehicle's turns between two of them
LONGEST_GAP_S = 0.5
_EARTH_RADPS = 7.292115e-5
_ACCEL = ("accel_x", "accel_y", "accel_z")


@dataclass(frozen=True, eq=False)
class ImuReadings:
    """What the inertial sensors measured about the body's forward, right and down axes.

    Attributes
    ----------
    time_s : (n,) increasing [s]
    gyro_radps : (n, 3) [rad/s]
    accel_mps2 : (n, 3) [m/s^2]
        Specific force: at rest about -9.8 downwards.
    """

    time_s: FloatArray
    gyro_radps: FloatArray
    accel_mps2: FloatArray

    def steps(self, time_s: FloatArray) -> FloatArray:
        """(m - 1, 6) rotation [rad] and velocity [m/s] gained between consecutive times (m,)."""
        rates = np.concatenate([self.gyro_radps, self.accel_mps2], axis=1)
        areas = 0.5 * np.diff(self.time_s)[:, None] * (rates[1:] + rates[:-1])
        integral = np.concatenate([np.zeros((1, 6)), np.cumsum(areas, axis=0)])
        return np.diff(np.stack([np.interp(time_s, self.time_s, column) for column in integral.T], axis=1), axis=0)

    def without(self, biases: FloatArray) -> ImuReadings:
        """The readings less constant biases (6,) [rad/s], [m/s^2]."""
        return ImuReadings(self.time_s, self.gyro_radps - biases[:3], self.accel_mps2 - biases[3:])


def check_imu(name: str, imu: ImuReadings, start_s: float, end_s: float) -> None:
    """Raise DataError where the readings are too slow, or have a gap, between two times [s]."""
    edges = np.concatenate([[start_s], imu.time_s[(imu.time_s > start_s) & (imu.time_s < end_s)], [end_s]])
    steps = np.diff(edges)
    longest = int(steps.argmax())
    if steps[longest] > LONGEST_GAP_S:
        raise DataError(
            f"{name}: the inertial sensors have no reading for {steps[longest]:.1f} s from {edges[longest]:.1f} s on, "
            f"expected gaps of at most {LONGEST_GAP_S:g} s for a strapdown INS"
        )
    rate_hz = 1.0 / float(np.median(steps))
    if rate_hz < SLOWEST_HZ:
        raise DataError(
            f"{name}: the inertial sensors are logged {rate_hz:.1f} times a second, expected at least {SLOWEST_HZ:g} "
            "for a strapdown INS"
        )


def imu_biases(imu: ImuReadings, known: Trajectory) -> FloatArray:
    """Biases of gyros and accelerometers over a stretch of known motion.

    Parameters
    ----------
    imu : ImuReadings
        Covers the stretch.
    known : Trajectory
        Attitude and velocity, at two times or more.

    Returns
    -------
    (6,) [rad/s] and [m/s^2]
    """
    dt = np.diff(known.time_s)[:, None]
    turned = Rotation.from_euler("ZYX", known.attitude_deg[:, ::-1], degrees=True)
    step = turned[:-1].inv() * turned[1:]
    middle = turned[:-1] * Rotation.from_rotvec(0.5 * step.as_rotvec())
    lat = np.radians(known.lat_deg[:-1])
    earth = _EARTH_RADPS * np.stack([np.cos(lat), np.zeros(lat.size), -np.sin(lat)], axis=1)
    force = np.diff(known.velocity_mps, axis=0) / dt - np.array([0.0, 0.0, GRAVITY_MPS2])
    expected = np.concatenate([step.as_rotvec() + dt * middle.inv().apply(earth), dt * middle.inv().apply(force)], 1)
    return np.asarray((imu.steps(known.time_s) - expected).sum(axis=0) / dt.sum())


def strapdown_of(
    imu: ImuReadings, start: Trajectory, time_s: FloatArray, altitude_m: FloatArray, *, step_s: float = STEP_S
) -> Trajectory:
    """Integrate logged inertial readings from a known start.

    Parameters
    ----------
    imu : ImuReadings
        Checked by `check_imu` over the times asked for.
    start : Trajectory
        One sample at time_s[0]: position, velocity, attitude.
    time_s : (m,) increasing [s]
        When to say where the INS is.
    altitude_m : (m,) [m]
        Barometric altitude that holds the vertical channel.
    step_s : float
        Of the integration [s].

    Returns
    -------
    Trajectory
        At `time_s`.
    """
    import pandas as pd

    even = time_s[0] + step_s * np.arange(int(np.ceil((time_s[-1] - time_s[0]) / step_s)) + 2)
    gained = imu.steps(even)
    # python-ins wants one increment before the first
    columns = pd.DataFrame(np.concatenate([gained[:1], gained]), index=even, columns=[*_GYRO, *_ACCEL])
    first = np.concatenate([[start.lat_deg[0], start.lon_deg[0], start.alt_m[0]], start.velocity_mps[0]])
    first = np.concatenate([first, start.attitude_deg[0]])
    held = np.interp(even, time_s, altitude_m)
    states = _integrated(columns, first, held, max(1, round(_HOLD_S / step_s)))
    states[:, 6:] = np.unwrap(states[:, 6:], axis=0, period=360.0)
    at = np.stack([np.interp(time_s, even, column) for column in states.T], axis=1)
    attitude = np.stack([(at[:, 6] + 180.0) % 360.0 - 180.0, at[:, 7], at[:, 8] % 360.0], axis=1)
    return Trajectory(time_s, at[:, 0], wrap_longitude(at[:, 1]), at[:, 2], at[:, 3:6], attitude)
