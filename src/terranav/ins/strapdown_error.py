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

from terranav.core.earth import ECCENTRICITY_SQ, GRAVITY_MPS2, SEMI_MAJOR_M, offset_of
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch

FloatArray = NDArray[np.float64]
Triple = tuple[float, float, float]

P, U, PHI, GYRO, ACCEL = (slice(i, i + 3) for i in range(0, 15, 3))  # of the 15 states
HELD = np.array([0, 1, 3, 4, *range(6, 15)])  # the 13 among them

EARTH_RATE_RADPS = 7.292115e-5
_GRAVITY_EQUATOR, _GRAVITY_FORM = 9.7803253359, 0.00193185265241  # of the WGS-84 normal gravity formula
_LAST_LAT_DEG = 89.0  # north-east-down has no meaning at the poles
_FASTEST_MPS = 1000.0  # of a velocity made from positions, which may jump
_SHORTEST_S = 1e-9  # what is less is no time
_TURN_DEG = 20.0  # attitude is taken as constant over a change of this
_MOST_PARTS = 12
_SERIES_S = 10.0  # the series below converge to 1e-11 over this time; longer ones are doubled
_ORDER = 6
_COEFFICIENTS = np.array([1.0 / math.factorial(k) for k in range(_ORDER + 1)])
_NODES, _WEIGHTS = (0.5 * part for part in np.polynomial.legendre.leggauss(4))
_NODES = _NODES + 0.5  # of the quadrature over [0, 1]; it keeps q positive whatever its error
_POWERS = _COEFFICIENTS * _NODES[:, None] ** np.arange(_ORDER + 1)


@dataclass(frozen=True, slots=True)
class Flight:
    """Latitude [deg], altitude [m], velocity north, east, down [m/s], and roll, pitch, heading [deg]."""

    lat_deg: float
    alt_m: float
    velocity_mps: Triple
    attitude_deg: Triple


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
    turned = [(b - a + 180.0) % 360.0 - 180.0 for a, b in zip(start.attitude_deg, end.attitude_deg, strict=True)]
    parts = min(max(1, math.ceil(max(map(abs, turned)) / _TURN_DEG)), _MOST_PARTS)
    gained = _cross(*((b - a) / dt for a, b in zip(start.velocity_mps, end.velocity_mps, strict=True)))
    phi, q = np.eye(13), np.zeros((13, 13))
    for i in range(parts):
        middle = _between(start, end, turned, (i + 0.5) / parts)
        to_u = to_platform(middle.velocity_mps)
        to_v = 2.0 * np.eye(13) - to_u  # its inverse: the part off the diagonal is nilpotent
        rate = to_v @ (system_matrix(middle) @ held(middle.velocity_mps))[HELD] @ to_u
        rate[2:4, 4:7] += gained[:2]
        step_phi, step_q = _stepped(rate, to_v @ noise_input(ins, middle.velocity_mps)[HELD], dt / parts)
        phi, q = step_phi @ phi, step_phi @ q @ step_phi.T + step_q
    return phi, 0.5 * (q + q.T)


def system_matrix(at: Flight) -> FloatArray:
    """Matrix F (15, 15) of the module's equations, x' = F x + noise."""
    v, rotation = _cross(*at.velocity_mps), attitude_matrix(at.attitude_deg)
    north, east, _ = at.velocity_mps
    lat = math.radians(min(max(at.lat_deg, -_LAST_LAT_DEG), _LAST_LAT_DEG))
    sin, cos = math.sin(lat), math.cos(lat)
    meridian, prime = _radii(lat, at.alt_m)
    gravity = _gravity(lat, at.alt_m)
    curvature = np.array([[0.0, 1.0 / prime, 0.0], [-1.0 / meridian, 0.0, 0.0], [0.0, -sin / cos / prime, 0.0]])
    earth = (EARTH_RATE_RADPS * cos, 0.0, -EARTH_RATE_RADPS * sin)
    transport = (east / prime, -north / meridian, -east * sin / cos / prime)
    earth_cross = _cross(*earth)
    both_cross = earth_cross + _cross(*transport)
    earth_change = np.zeros((3, 3))
    earth_change[:, 0] = earth[2] / meridian, 0.0, -earth[0] / meridian

    f = np.zeros((15, 15))
    f[P, U] = np.eye(3)
    f[P, PHI] = v
    f[1, 0], f[1, 1] = east * sin / cos / prime, -north * sin / cos / prime
    f[U, P] = v @ earth_change
    f[5, 2] += 2.0 * _gravity(lat, 0.0) / SEMI_MAJOR_M
    f[U, U] = -(both_cross + earth_cross)
    f[U, PHI] = -(v @ earth_cross)
    f[3, 7] += gravity
    f[4, 6] -= gravity
    f[U, GYRO] = v @ rotation
    f[U, ACCEL] = rotation
    f[PHI, P] = earth_change
    f[8, 0] -= east / (cos * cos * prime * meridian)
    f[PHI, U] = curvature
    f[PHI, PHI] = curvature @ v - both_cross
    f[PHI, GYRO] = -rotation
    return f


def noise_input(ins: InsGrade, velocity_mps: Triple) -> FloatArray:
    """Matrix G (15, 8) of the white noises: spectral density G G'.

    Position walk (2), velocity walk and the accelerometers' noise (3), the gyros' noise (3). The three axes of a sensor
    are alike, so that its noise is the same in NED as in the body.
    """
    accel = math.hypot(ins.velocity_walk_mps_per_sqrt_s, ins.accel_walk_mps_per_sqrt_h / 60.0)
    gyro = math.radians(ins.gyro_walk_deg_per_sqrt_h) / 60.0
    g = np.zeros((15, 8))
    g[0, 0] = g[1, 1] = ins.position_walk_m_per_sqrt_s
    g[3, 2] = g[4, 3] = g[5, 4] = accel
    g[U, 5:] = gyro * _cross(*velocity_mps)
    g[6, 5] = g[7, 6] = g[8, 7] = -gyro
    return g


def held(velocity_mps: Triple) -> FloatArray:
    """Matrix (15, 13) that makes 15 states of 13: no error of height and of indicated vertical velocity."""
    north, east, _ = velocity_mps
    lift = np.zeros((15, 13))
    lift[HELD, np.arange(13)] = 1.0
    lift[5, 4], lift[5, 5] = east, -north  # 0 = u_d + (V x phi)_d
    return lift


def to_platform(velocity_mps: Triple) -> FloatArray:
    """Matrix (13, 13) that turns the velocity error v of the 13 states into u = v - V x phi."""
    north, east, down = velocity_mps
    turn = np.eye(13)
    turn[2, 5], turn[2, 6] = down, -east
    turn[3, 4], turn[3, 6] = -down, north
    return turn


def attitude_matrix(attitude_deg: Triple) -> FloatArray:
    """Rotation (3, 3) from body to NED of roll, pitch and heading (heading first, roll last)."""
    roll, pitch, heading = map(math.radians, attitude_deg)
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sh, ch = math.sin(heading), math.cos(heading)
    return np.array(
        [
            [cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh],
            [cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch],
            [-sp, sr * cp, cr * cp],
        ]
    )


def _stepped(f: FloatArray, g: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Transition and noise covariance over dt of x' = f x + g white noise: series over a part of dt, then doubled."""
    doublings = math.ceil(math.log2(max(dt, _SERIES_S) / _SERIES_S))
    h = dt / 2.0**doublings
    power, shaped = np.eye(len(f)), g
    phi, series = power, [shaped]
    for k in range(1, _ORDER + 1):
        power, shaped = (h * f) @ power, (h * f) @ shaped
        phi = phi + _COEFFICIENTS[k] * power
        series.append(shaped)
    at_nodes = np.tensordot(_POWERS, np.stack(series), axes=1) * np.sqrt(h * _WEIGHTS)[:, None, None]
    root = at_nodes.transpose(1, 0, 2).reshape(len(f), -1)
    q = root @ root.T
    for _ in range(doublings):
        phi, q = phi @ phi, phi @ q @ phi.T + q
    return phi, q


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


def _between(start: Flight, end: Flight, turned: list[float], share: float) -> Flight:
    """The flight a share of the way from start to end."""
    n, e, d = (a + share * (b - a) for a, b in zip(start.velocity_mps, end.velocity_mps, strict=True))
    roll, pitch, heading = (a + share * turn for a, turn in zip(start.attitude_deg, turned, strict=True))
    lat, alt = start.lat_deg + share * (end.lat_deg - start.lat_deg), start.alt_m + share * (end.alt_m - start.alt_m)
    return Flight(lat, alt if math.isfinite(alt) else 0.0, (n, e, d), (roll, pitch, heading))


def _cross(n: float, e: float, d: float) -> FloatArray:
    """[a x]: _cross(*a) @ b = a x b."""
    return np.array([[0.0, -d, e], [d, 0.0, -n], [-e, n, 0.0]])


def _radii(lat: float, alt_m: float) -> tuple[float, float]:
    """Meridian and prime-vertical radii of curvature at a height [m]; latitude [rad]."""
    w2 = 1.0 - ECCENTRICITY_SQ * math.sin(lat) ** 2
    prime = SEMI_MAJOR_M / math.sqrt(w2)
    return prime * (1.0 - ECCENTRICITY_SQ) / w2 + alt_m, prime + alt_m


def _gravity(lat: float, alt_m: float) -> float:
    """Normal gravity of WGS-84 (Somigliana's formula), less with height [m/s^2]; latitude [rad]."""
    s2 = math.sin(lat) ** 2
    at_sea = _GRAVITY_EQUATOR * (1.0 + _GRAVITY_FORM * s2) / math.sqrt(1.0 - ECCENTRICITY_SQ * s2)
    return at_sea * (1.0 - 2.0 * alt_m / SEMI_MAJOR_M)
