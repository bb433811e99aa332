"""An INS made from a track whose position is true: the drift of a given grade, on position level.

Per horizontal axis, with e0, v0, the biases and the walks drawn from the InsGrade (t from the start), a grade on
position level has

    error(t) = e0 + v0 t + position walk + integral of the velocity walk

and one with figures of its inertial sensors (`InsGrade.has_schuler_loop`; w: Schuler rate)

    error(t) = e0 + v0 sin(wt)/w + position walk + response of the Schuler loop to the velocity walk
               + a (1 - cos wt)/w^2 + g b (t - sin(wt)/w)/w^2 + response to the gyro's angular random walk

a is the acceleration error of initial tilt and accelerometer bias, b the gyro bias (Groves, Principles of GNSS,
Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., section 5.7). A velocity error tilts the platform as
it carries it around the Earth, so in the loop no velocity error is constant: the loop turns v + i w p at the rate w.
This is the drift that level 'schuler' of `terranav.ins.error_state` expects. The sigma of the velocity error is at most
`InsGrade.velocity_sigma_at_mps`. Heading errors, which act through manoeuvres, and biases that turn with the vehicle
are met only in a strapdown simulation (`terranav.ins.strapdown`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import GRAVITY_MPS2, SCHULER_RAD_PER_S, shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import TRUTH, Recording

FloatArray = NDArray[np.float64]


def add_drift(rec: Recording, ins: InsGrade, seed: int | Generator) -> Recording:
    """Give a recording an INS that drifts: indicated position = true position + error.

    The truth is the recording's own where it has one; otherwise the indicated position is taken for true and copied to
    the columns true_*. The altitude stays as indicated: a barometer holds it. Velocities become those of the new INS:
    the rate of the old error (if any) is taken out of vn_mps and ve_mps, the velocity error of the new one is added.
    That is the slow part of the drift: a position walk is not differentiated. Attitude and readings stay.

    Parameters
    ----------
    rec : Recording
    ins : InsGrade
        The drift is drawn from it; it becomes `rec.ins`.
    seed : int or Generator
        The same seed gives the same bits, and the same draws scaled for another grade.

    Returns
    -------
    Recording
        With the columns true_lat_deg, true_lon_deg, true_alt_m, and the drift noted in `source`.

    Raises
    ------
    DataError
        When the recording has a true position at some epochs only.
    ConfigError
        When the seed is not one.
    """
    columns = dict(rec.columns)
    old_rate: FloatArray = np.zeros((len(rec), 2))
    if rec.has_truth:
        for key in TRUTH[:2]:
            missing = np.flatnonzero(~np.isfinite(columns[key]))
            if missing.size:
                raise DataError(
                    f"{rec.name}: {key} in row {missing[0] + 1} is empty, expected the truth at every epoch"
                )
        if len(rec) > 1:
            old_rate = np.asarray(np.gradient(rec.ins_error_m(), rec.time_s, axis=0))
        columns.setdefault(TRUTH[2], rec.alt_m)
    else:
        columns |= dict(zip(TRUTH, (rec.lat_deg, rec.lon_deg, rec.alt_m), strict=True))
    position_m, velocity_mps = draw_drift(rec.time_s, ins, _generator(seed))
    columns["lat_deg"], columns["lon_deg"] = shift(*(columns[key] for key in TRUTH[:2]), *position_m.T)
    for axis, key in enumerate(("vn_mps", "ve_mps")):
        if key in columns:
            columns[key] = columns[key] - old_rate[:, axis] + velocity_mps[:, axis]
    origin = f"seed {seed}" if not isinstance(seed, Generator) else "a given generator"
    grade = f"grade {ins.name!r}, " if ins.name else ""
    note = (
        f"{grade}{ins.position_sigma_m:g} m, {ins.velocity_sigma_mps:g} m/s, "
        f"walk {ins.position_walk_m_per_sqrt_s:g} m/sqrt(s); {origin}"
    )
    return replace(rec, columns=columns, ins=ins, source={**rec.source, "added_drift": note})


def draw_drift(time_s: FloatArray, ins: InsGrade, rng: Generator) -> tuple[FloatArray, FloatArray]:
    """One drift of an INS of this grade (the module's formula).

    Parameters
    ----------
    time_s : (n,) increasing [s]
        The drift starts at the first.
    ins : InsGrade
    rng : Generator

    Returns
    -------
    position_m : (n, 2) [m] north, east
    velocity_mps : (n, 2) [m/s]
        Its slow part: everything but the position walk.
    """
    elapsed = (time_s - time_s[0])[:, None]
    dt = np.diff(time_s)[:, None]
    start, speed, accel, gyro = rng.standard_normal((4, 2))
    walk, velocity_walk, within_step, angle_walk = rng.standard_normal((4, dt.size, 2))

    speed_walk_sigma = math.hypot(ins.velocity_walk_mps_per_sqrt_s, ins.accel_walk_mps_per_sqrt_h / 60.0)
    kicks = speed_walk_sigma * np.sqrt(dt) * velocity_walk
    # given both ends, the integral of a walk over a step is normal about the trapezoid with variance dt^3 / 12
    within = speed_walk_sigma * np.sqrt(dt**3 / 12.0) * within_step
    position_walk = ins.position_walk_m_per_sqrt_s * np.sqrt(dt) * walk
    v0 = ins.velocity_sigma_mps * speed
    if not ins.has_schuler_loop:
        speed_walk = _running(kicks)
        travelled = 0.5 * dt * (speed_walk[1:] + speed_walk[:-1]) + within
        position = ins.position_sigma_m * start + v0 * elapsed
        return position + _running(position_walk + travelled), v0 + speed_walk
    position = ins.position_sigma_m * start + _running(position_walk)
    swung_position, swung_velocity = _swung(elapsed, v0, kicks, within)
    schuler_position, schuler_velocity = _schuler(elapsed, ins, accel, gyro, np.sqrt(dt) * angle_walk)
    return position + swung_position + schuler_position, swung_velocity + schuler_velocity


def _swung(elapsed: FloatArray, v0: FloatArray, kicks: FloatArray, within: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (n, 2) in the Schuler loop of v0, and of each step's gains at its middle."""
    w = SCHULER_RAD_PER_S
    turn = np.exp(1j * w * elapsed)
    middle = np.exp(0.5j * w * (elapsed[1:] + elapsed[:-1]))
    turned = turn * (v0 + _running((kicks + 1j * w * within) / middle))
    return turned.imag / w, turned.real


def _schuler(
    elapsed: FloatArray, ins: InsGrade, accel: FloatArray, gyro: FloatArray, angle_walk: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (n, 2) that tilt, biases and the gyros' angular random walk cause in the Schuler loop."""
    g, w = GRAVITY_MPS2, SCHULER_RAD_PER_S
    phase = w * elapsed
    a = g * math.hypot(math.radians(ins.attitude_sigma_deg), 1e-6 * ins.accel_bias_sigma_ug) * accel
    b = g * math.radians(ins.gyro_bias_sigma_deg_per_h) / 3600.0 * gyro
    # a tilt step k at time t_k answers with velocity k sin(w (t - t_k)) and position k (1 - cos(w (t - t_k))) / w
    steps = g * math.radians(ins.gyro_walk_deg_per_sqrt_h) / 60.0 / w * angle_walk
    middle = 0.5 * (phase[1:] + phase[:-1])
    turned = np.exp(-1j * phase) * _running(steps * np.exp(1j * middle))
    position = a * (1.0 - np.cos(phase)) / w**2 + b * (elapsed - np.sin(phase) / w) / w**2
    velocity = a * np.sin(phase) / w + b * (1.0 - np.cos(phase)) / w**2
    return position + (_running(steps) - turned.real) / w, velocity - turned.imag


def _running(steps: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Running sums (n, 2) of steps (n - 1, 2), from zero."""
    return np.concatenate([np.zeros((1, 2), dtype=steps.dtype), np.cumsum(steps, axis=0)])


def _generator(seed: int | Generator) -> Generator:
    """A random generator from a seed or from one."""
    if isinstance(seed, Generator):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ConfigError(f"seed is {seed!r}, expected a whole number >= 0 or a numpy Generator")
    return np.random.default_rng(seed)
