"""The matrices of `terranav.ins.strapdown_error`, which has the equations and the order of the states.

A flight is eight numbers: latitude [deg], altitude [m], velocity north, east, down [m/s], roll, pitch, heading [deg].
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.matrices import product

SEMI_MAJOR_M, ECCENTRICITY_SQ = 6378137.0, 0.0066943799901413165  # WGS-84, as in `terranav.core.earth`
EARTH_RATE_RADPS = 7.292115e-5
GRAVITY_EQUATOR, GRAVITY_FORM = 9.7803253359, 0.00193185265241  # of the WGS-84 normal gravity formula
LAST_LAT_DEG = 89.0  # north-east-down has no meaning at the poles
TURN_DEG = 20.0  # attitude is taken as constant over a change of this
MOST_PARTS = 12
SERIES_S = 10.0  # the series below converge to 1e-11 over this time; longer ones are doubled
ORDER = 6
NODES = 0.5 + 0.5 * np.array([-0.8611363115940526, -0.33998104358485626, 0.33998104358485626, 0.8611363115940526])
WEIGHTS = 0.5 * np.array([0.34785484513745385, 0.6521451548625461, 0.6521451548625461, 0.34785484513745385])
HELD = np.array([0, 1, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14])  # the 13 states among the 15


@jit
def attitude_matrix(roll_deg, pitch_deg, heading_deg):
    """Rotation (3, 3) from body to NED (heading first, roll last)."""
    roll, pitch, heading = math.radians(roll_deg), math.radians(pitch_deg), math.radians(heading_deg)
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sh, ch = math.sin(heading), math.cos(heading)
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh
    out[1, 0], out[1, 1], out[1, 2] = cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch
    out[2, 0], out[2, 1], out[2, 2] = -sp, sr * cp, cr * cp
    return out


@jit
def _cross(n, e, d):
    """[a x]: _cross(*a) @ b = a x b."""
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -d, e, -n
    out[1, 0], out[2, 0], out[2, 1] = d, -e, n
    return out


@jit
def _gravity(sin2, alt_m):
    """Normal gravity (Somigliana's formula), less with height [m/s^2]; sin2 of the latitude."""
    at_sea = GRAVITY_EQUATOR * (1.0 + GRAVITY_FORM * sin2) / math.sqrt(1.0 - ECCENTRICITY_SQ * sin2)
    return at_sea * (1.0 - 2.0 * alt_m / SEMI_MAJOR_M)


@jit
def _put(f, row, col, block, sign):
    """f[row:row + 3, col:col + 3] += sign block."""
    for i in range(3):
        for j in range(3):
            f[row + i, col + j] += sign * block[i, j]


@jit
def system_matrix(at):
    """Matrix F (15, 15) of a flight (8,)."""
    north, east = at[2], at[3]
    v, rotation = _cross(north, east, at[4]), attitude_matrix(at[5], at[6], at[7])
    lat = math.radians(min(max(at[0], -LAST_LAT_DEG), LAST_LAT_DEG))
    sin, cos = math.sin(lat), math.cos(lat)
    w2 = 1.0 - ECCENTRICITY_SQ * sin * sin
    prime = SEMI_MAJOR_M / math.sqrt(w2)
    meridian, prime = prime * (1.0 - ECCENTRICITY_SQ) / w2 + at[1], prime + at[1]
    gravity, tangent = _gravity(sin * sin, at[1]), sin / cos
    curvature, change = np.zeros((3, 3)), np.zeros((3, 3))
    curvature[0, 1], curvature[1, 0], curvature[2, 1] = 1.0 / prime, -1.0 / meridian, -tangent / prime
    rate_n, rate_d = EARTH_RATE_RADPS * cos, -EARTH_RATE_RADPS * sin
    change[0, 0], change[2, 0] = rate_d / meridian, -rate_n / meridian
    earth = _cross(rate_n, 0.0, rate_d)
    both = earth + _cross(east / prime, -north / meridian, -east * tangent / prime)
    work = np.empty((3, 3))
    f = np.zeros((15, 15))
    f[0, 3] = f[1, 4] = f[2, 5] = 1.0
    _put(f, 0, 6, v, 1.0)
    f[1, 0], f[1, 1] = east * tangent / prime, -north * tangent / prime
    product(v, change, work)
    _put(f, 3, 0, work, 1.0)
    f[5, 2] += 2.0 * _gravity(sin * sin, 0.0) / SEMI_MAJOR_M
    _put(f, 3, 3, both, -1.0)
    _put(f, 3, 3, earth, -1.0)
    product(v, earth, work)
    _put(f, 3, 6, work, -1.0)
    f[3, 7] += gravity
    f[4, 6] -= gravity
    product(v, rotation, work)
    _put(f, 3, 9, work, 1.0)
    _put(f, 3, 12, rotation, 1.0)
    _put(f, 6, 0, change, 1.0)
    f[8, 0] -= east / (cos * cos * prime * meridian)
    _put(f, 6, 3, curvature, 1.0)
    product(curvature, v, work)
    _put(f, 6, 6, work, 1.0)
    _put(f, 6, 6, both, -1.0)
    _put(f, 6, 9, rotation, -1.0)
    return f


@jit
def noise_input(north, east, down, position, accel, gyro):
    """Matrix G (15, 8) of the white noises at a velocity: walk of the position, accelerometers, gyros (densities)."""
    g, v = np.zeros((15, 8)), _cross(north, east, down)
    g[0, 0] = g[1, 1] = position
    g[3, 2] = g[4, 3] = g[5, 4] = accel
    for i in range(3):
        for j in range(3):
            g[3 + i, 5 + j] = gyro * v[i, j]
    g[6, 5] = g[7, 6] = g[8, 7] = -gyro
    return g


@jit
def held(north, east):
    """Matrix (15, 13) that makes 15 states of 13."""
    lift = np.zeros((15, 13))
    for j in range(13):
        lift[HELD[j], j] = 1.0
    lift[5, 4], lift[5, 5] = east, -north  # 0 = u_d + (V x phi)_d
    return lift


@jit
def to_platform(north, east, down):
    """Matrix (13, 13) that turns the velocity error v of the 13 states into u = v - V x phi."""
    turn = np.eye(13)
    turn[2, 5], turn[2, 6] = down, -east
    turn[3, 4], turn[3, 6] = -down, north
    return turn


@jit
def _symmetric(q):
    """The mean of q and q', in place."""
    for i in range(len(q)):
        for j in range(i):
            q[i, j] = q[j, i] = 0.5 * (q[i, j] + q[j, i])


@jit
def _series(f, g, dt):
    """What `discretised` says."""
    n, k = g.shape
    doublings = math.ceil(math.log2(max(dt, SERIES_S) / SERIES_S))
    h = dt / 2.0**doublings
    phi, power, shaped = np.eye(n), np.eye(n), g.copy()
    nodes = len(NODES)
    root = np.empty((nodes, n, k))
    for a in range(nodes):
        root[a] = g
    next_power, next_shaped, step = np.empty((n, n)), np.empty((n, k)), h * f
    factor, scale = 1.0, np.ones(nodes)
    for order in range(1, ORDER + 1):
        product(step, power, next_power)
        product(step, shaped, next_shaped)
        power[:], shaped[:] = next_power, next_shaped
        factor /= order
        for i in range(n):
            for j in range(n):
                phi[i, j] += factor * power[i, j]
        for a in range(nodes):
            scale[a] *= NODES[a] / order
            for i in range(n):
                for j in range(k):
                    root[a, i, j] += scale[a] * shaped[i, j]
    q = np.zeros((n, n))
    for a in range(nodes):
        share, turned = h * WEIGHTS[a], root[a].T.copy()
        for c in range(k):
            for i in range(n):
                each = share * turned[c, i]
                if each != 0.0:
                    for j in range(n):
                        q[i, j] += each * turned[c, j]
    half, other = np.empty((n, n)), np.empty((n, n))
    for _ in range(doublings):
        product(phi, q, half)
        product(phi, half.T.copy(), other)
        for i in range(n):
            for j in range(n):
                q[i, j] += other[i, j]
        product(phi, phi, half)
        phi[:] = half
    _symmetric(q)
    return phi, q


@jit
def discretised(f, g, dt):
    """Transition and noise covariance over dt of x' = f x + g white noise: series over a part of dt, then doubled.

    For systems as slow as an INS, whose rates SERIES_S is made for. The quadrature over four Gauss-Legendre nodes keeps
    q positive whatever its error.

    Parameters
    ----------
    f : (n, n), g : (n, k)
    dt : float [s]

    Returns
    -------
    phi, q : (n, n)
    """
    return _series(f, g, dt)  # numba cannot always give back arrays of what other kernels call, too


@jit
def transition(start, end, dt, position, accel, gyro):
    """Step the 13 states over dt > 0 from one flight (8,) to the next; the densities are those of `noise_input`.

    Returns
    -------
    phi, q : (13, 13)
    """
    turned, most = np.empty(3), 0.0
    for i in range(3):
        turned[i] = (end[5 + i] - start[5 + i] + 180.0) % 360.0 - 180.0
        most = max(most, abs(turned[i]))
    parts = int(min(max(1.0, math.ceil(most / TURN_DEG)), MOST_PARTS))
    gained = _cross((end[2] - start[2]) / dt, (end[3] - start[3]) / dt, (end[4] - start[4]) / dt)
    phi, q, at = np.eye(13), np.zeros((13, 13)), np.empty(8)
    lifted, rows, rate, half = np.empty((15, 13)), np.empty((13, 13)), np.empty((13, 13)), np.empty((13, 13))
    noise, shaped = np.empty((13, 8)), np.empty((13, 8))
    for part in range(parts):
        share = (part + 0.5) / parts
        for i in range(5):
            at[i] = start[i] + share * (end[i] - start[i])
        for i in range(3):
            at[5 + i] = start[5 + i] + share * turned[i]
        at[1] = at[1] if math.isfinite(at[1]) else 0.0
        to_u = to_platform(at[2], at[3], at[4])
        to_v = 2.0 * np.eye(13) - to_u  # its inverse: the part off the diagonal is nilpotent
        product(system_matrix(at), held(at[2], at[3]), lifted)
        given = noise_input(at[2], at[3], at[4], position, accel, gyro)
        for i in range(13):
            for j in range(13):
                rows[i, j] = lifted[HELD[i], j]
            for j in range(8):
                noise[i, j] = given[HELD[i], j]
        product(to_v, rows, half)
        product(half, to_u, rate)
        product(to_v, noise, shaped)
        for i in range(2):
            for j in range(3):
                rate[2 + i, 4 + j] += gained[i, j]
        step_phi, step_q = _series(rate, shaped, dt / parts)
        product(step_phi, phi, half)
        phi[:] = half
        product(step_phi, q, half)
        product(step_phi, half.T.copy(), q)
        for i in range(13):
            for j in range(13):
                q[i, j] += step_q[i, j]
    _symmetric(q)
    return phi, q
