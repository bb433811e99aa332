"""Error states of a strapdown INS whose attitude is known: tilt, heading, gyro and accelerometer biases.

All errors are indicated minus true; frame north-east-down, body axes forward-right-down; V velocity, C attitude (body
to NED), g gravity, W Earth rate, rho transport rate, R curvature (rho = R V), [a x] the matrix of the cross product.
phi turns the platform to the truth: indicated C = (I - [phi x]) C. The 15 states are position r [m], velocity u [m/s],
attitude phi [rad], gyro bias b_g [rad/s], accelerometer bias b_a [m/s^2], the biases constant in body axes:

    r'   = u + V x phi + convergence            convergence: (0, (V_e r_n - V_n r_e) tan(latitude) / R_e, 0)
    u'   = -(2 W + rho) x u - g x phi + V x (dW - W x phi) + (0, 0, 2 g r_d / R_e) + C b_a + V x C b_g
    phi' = dW + R (u + V x phi) + drho - (W + rho) x phi - C b_g

u is the velocity error resolved in the platform's axes, so that no specific force appears: the modified phi-angle model
(Scherzinger and Reid, Modified strapdown inertial navigator error models, IEEE PLANS 1994). dW and drho are what W and
rho change with the latitude. These, W x phi and the convergence of the meridians are first-order terms like the rest,
but small, and often dropped (python-ins keeps only dW in phi'). How R changes with height and latitude is not carried.
The matrix is taken at the indicated trajectory.

**The states of the estimators** are 13, for the barometer holds the vertical channel (r_d = 0, indicated V_d true): r
and v of north and east, phi, b_g, b_a, with

    v = u + V x phi,   v' = u' + V x phi' + V' x phi

the error of the indicated velocity, so that v and phi are independent at the start, as an alignment (and
`terranav.ins.strapdown`) leaves them. V' is what the indicated velocity gains from one epoch to the next: through it
the attitude error acts in manoeuvres, as it does through the specific force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import GRAVITY_MPS2, offset_of
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch
from terranav.kernels import strapdown as kernels

FloatArray = NDArray[np.float64]
Triple = tuple[float, float, float]

HELD = kernels.HELD  # the 13 states among the 15
_FASTEST_MPS = 1000.0  # of a velocity made from positions, which may jump
_SHORTEST_S = 1e-9  # what is less is no time


@dataclass(frozen=True, slots=True)
class Flight:
    """Latitude [deg], altitude [m], velocity north, east, down [m/s], and roll, pitch, heading [deg]."""

    lat_deg: float
    alt_m: float
    velocity_mps: Triple
    attitude_deg: Triple

    @property
    def numbers(self) -> FloatArray:
        """(8,) all of them, for the kernels."""
        return np.array((self.lat_deg, self.alt_m, *self.velocity_mps, *self.attitude_deg), dtype=np.float64)


def initial_covariance(ins: InsGrade) -> FloatArray:
    """Covariance (9, 9) of tilt north and east, heading [rad], gyro biases [rad/s], accelerometer biases [m/s^2].

    All independent, as `terranav.ins.strapdown` draws them: tilt about north and east whatever the heading, biases in
    body axes.
    """
    tilt, heading = math.radians(ins.attitude_sigma_deg), math.radians(ins.heading_sigma_deg)
    gyro = math.radians(ins.gyro_bias_sigma_deg_per_h) / 3600.0
    accel = 1e-6 * GRAVITY_MPS2 * ins.accel_bias_sigma_ug
    return np.diag(np.array([tilt, tilt, heading, gyro, gyro, gyro, accel, accel, accel]) ** 2)


def transition(ins: InsGrade, before: Epoch, after: Epoch) -> tuple[FloatArray, FloatArray]:
    """Step the 13 states from one epoch to the next.

    Velocity and attitude are interpolated between the epochs. Where one epoch lacks them the other's are taken; where
    both do, velocity is the displacement over the time, and the vehicle flies level along its track.

    Parameters
    ----------
    ins : InsGrade
        Its sensors' white noise, and its walks of velocity and position.
    before, after : Epoch
        `after` not earlier.

    Returns
    -------
    phi, q : (13, 13)
        x after = phi x before + noise of covariance q (symmetric, positive semidefinite); x = position and velocity
        error north and east [m], [m/s], then the states of `initial_covariance`.
    """
    dt = after.time_s - before.time_s
    if dt < _SHORTEST_S:
        return np.eye(13), np.zeros((13, 13))
    start, end = _ends(before, after)
    phi, q = kernels.transition(start.numbers, end.numbers, dt, ins.position_walk_m_per_sqrt_s, *_densities(ins))
    return phi, q


def system_matrix(at: Flight) -> FloatArray:
    """Matrix F (15, 15) of the module's equations, x' = F x + noise."""
    return np.asarray(kernels.system_matrix(at.numbers))


def noise_input(ins: InsGrade, velocity_mps: Triple) -> FloatArray:
    """Matrix G (15, 8) of the white noises: spectral density G G'.

    Position walk (2), velocity walk and the accelerometers' noise (3), the gyros' noise (3). The three axes of a sensor
    are alike, so that its noise is the same in NED as in the body.
    """
    return np.asarray(kernels.noise_input(*velocity_mps, ins.position_walk_m_per_sqrt_s, *_densities(ins)))


def held(velocity_mps: Triple) -> FloatArray:
    """Matrix (15, 13) that makes 15 states of 13: no error of height and of indicated vertical velocity."""
    return np.asarray(kernels.held(*velocity_mps[:2]))


def to_platform(velocity_mps: Triple) -> FloatArray:
    """Matrix (13, 13) that turns the velocity error v of the 13 states into u = v - V x phi."""
    return np.asarray(kernels.to_platform(*velocity_mps))


def _densities(ins: InsGrade) -> tuple[float, float]:
    """White noise of accelerometers (the walk of the velocity with it) and gyros [m/s/sqrt(s)], [rad/sqrt(s)]."""
    accel = math.hypot(ins.velocity_walk_mps_per_sqrt_s, ins.accel_walk_mps_per_sqrt_h / 60.0)
    return accel, math.radians(ins.gyro_walk_deg_per_sqrt_h) / 60.0


def _ends(before: Epoch, after: Epoch) -> tuple[Flight, Flight]:
    """The flight at both epochs, what is missing filled in."""
    velocities = _filled(before.velocity_mps, after.velocity_mps)
    if velocities is None:
        north, east = offset_of(before.lat_deg, before.lon_deg, after.lat_deg, after.lon_deg)
        per_s = 1.0 / max(after.time_s - before.time_s, math.hypot(north, east) / _FASTEST_MPS)
        velocities = ((north * per_s, east * per_s, 0.0),) * 2
    attitudes = _filled(before.attitude_deg, after.attitude_deg)
    if attitudes is None:
        north, east = (velocities[0][i] + velocities[1][i] for i in (0, 1))
        attitudes = ((0.0, 0.0, math.degrees(math.atan2(east, north))),) * 2
    return (
        Flight(before.lat_deg, before.alt_m, velocities[0], attitudes[0]),
        Flight(after.lat_deg, after.alt_m, velocities[1], attitudes[1]),
    )


def _filled(first: Triple | None, last: Triple | None) -> tuple[Triple, Triple] | None:
    """Both, one for both, or None."""
    known = [each for each in (first, last) if each is not None and all(map(math.isfinite, each))]
    return (known[0], known[-1]) if known else None
