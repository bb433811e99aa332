"""The linear model of what drifts: the INS error, and what the readings of one map have in common.

One model serves the estimators that carry these states and the Cramer-Rao bound. State x, in this order:

    p   position error north, east [m]
    v   velocity error north, east [m/s]
    ... of the inertial sensors, by what is known of them (`level`):
        'position'  nothing more: v is constant but for its walk
        'schuler'   per axis an acceleration error a [m/s^2] (tilt and accelerometer bias) and its drift b [m/s^3] (gyro
                    bias): dv/dt = a, da/dt = b - w^2 v, w the Schuler rate (`terranav.core.ins_grade`)
        'strapdown' tilt, heading, gyro and accelerometer biases (`terranav.ins.strapdown_error`)
    per map its bias [unit], a constant with a random walk, and its patch [unit], the map error of the ground below:
        stationary along the track, covariance sigma^2 exp(-travelled / correlation length)

A reading of a map is y = h(true position) + bias + patch + white noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite, unknown_name
from terranav.core.earth import GRAVITY_MPS2, SCHULER_RAD_PER_S, offset_of
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS, kind_named
from terranav.core.records import Epoch
from terranav.kernels.matrices import then
from terranav.kernels.strapdown import discretised
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Level = Literal["position", "schuler", "strapdown"]

POSITION, VELOCITY = slice(0, 2), slice(2, 4)

_SCHULER_LOOP = np.array(
    [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -(SCHULER_RAD_PER_S**2), 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]]
)  # of one axis: dp/dt = v, dv/dt = a, da/dt = b - w^2 v


@dataclass(frozen=True, slots=True)
class Transition:
    """x after a step = phi x + noise of covariance q; both (d, d)."""

    phi: FloatArray
    q: FloatArray

    def then(self, later: Transition) -> Transition:
        """Both steps as one."""
        return Transition(*then(self.phi, self.q, later.phi, later.q))


@dataclass(frozen=True)
class ErrorModel:
    """Initial covariance, transitions and measurement of the states above.

    Attributes
    ----------
    ins : InsGrade
    maps : tuple of Map
        One a kind.
    level : 'position', 'schuler' or 'strapdown'
        Which inertial states there are; `ErrorModel.level_for` chooses.
    bias_sigma : mapping of kind to float
        1-sigma of the bias [unit]; kinds that are not named take `Kind.bias_sigma`.
    """

    ins: InsGrade
    maps: tuple[Map, ...]
    level: Level = "position"
    bias_sigma: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def level_for(ins: InsGrade, epoch: Epoch) -> Level:
        """The most detailed level that an INS and what its epochs carry allow."""
        if not ins.has_schuler_loop:
            return "position"
        return "schuler" if epoch.velocity_mps is None or epoch.attitude_deg is None else "strapdown"

    @cached_property
    def inertial(self) -> int:
        """How many states come before those of the maps."""
        return {"position": 4, "schuler": 8, "strapdown": 13}[self.level]

    @property
    def size(self) -> int:
        """Number of states d."""
        return self.inertial + 2 * len(self.maps)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each state, with its unit."""
        more = {
            "position": (),
            "schuler": ("accel_north_mps2", "accel_east_mps2", "accel_drift_north_mps3", "accel_drift_east_mps3"),
            "strapdown": (
                "tilt_north_rad", "tilt_east_rad", "heading_rad",
                "gyro_bias_x_radps", "gyro_bias_y_radps", "gyro_bias_z_radps",
                "accel_bias_x_mps2", "accel_bias_y_mps2", "accel_bias_z_mps2",
            ),
        }[self.level]  # fmt: skip
        of_maps = [f"{chart.kind}_{what}" for chart in self.maps for what in ("bias", "patch")]
        return ("north_m", "east_m", "vn_mps", "ve_mps", *more, *of_maps)

    def bias_index(self, kind: str) -> int:
        """Index in x of the bias of a kind; its patch comes next."""
        return self.inertial + 2 * [chart.kind for chart in self.maps].index(kind)

    def bias_sigma_of(self, kind: str) -> float:
        """1-sigma of the bias of a kind at the start [unit]."""
        return float(self.bias_sigma.get(kind, kind_named(kind).bias_sigma))

    def initial_covariance(self, position_cov_m2: FloatArray) -> FloatArray:
        """(d, d) at the start; the mean is zero but for the position's."""
        ins = self.ins
        cov = np.zeros((self.size, self.size))
        cov[POSITION, POSITION] = position_cov_m2
        cov[VELOCITY, VELOCITY] = ins.velocity_sigma_mps**2 * np.eye(2)
        if self.level == "schuler":
            tilt = GRAVITY_MPS2 * math.radians(ins.attitude_sigma_deg)
            accel = GRAVITY_MPS2 * 1e-6 * ins.accel_bias_sigma_ug
            drift = GRAVITY_MPS2 * math.radians(ins.gyro_bias_sigma_deg_per_h) / 3600.0
            cov[4:8, 4:8] = np.diag([tilt**2 + accel**2] * 2 + [drift**2] * 2)
        elif self.level == "strapdown":
            from terranav.ins.strapdown_error import initial_covariance  # brings the Earth model: only when used

            cov[4:13, 4:13] = initial_covariance(ins)
        for chart in self.maps:
            i = self.bias_index(chart.kind)
            cov[i, i] = self.bias_sigma_of(chart.kind) ** 2
            cov[i + 1, i + 1] = chart.sigma**2
        return cov

    def transition(self, before: Epoch, after: Epoch) -> Transition:
        """From one epoch to the next."""
        dt = after.time_s - before.time_s
        n = self.inertial
        phi, q = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        if self.level == "strapdown":
            from terranav.ins.strapdown_error import transition

            phi[:n, :n], q[:n, :n] = transition(self.ins, before, after)
        else:
            phi[:n, :n], q[:n, :n] = _planar(self.ins, self.level, dt)
        travelled = math.hypot(*offset_of(before.lat_deg, before.lon_deg, after.lat_deg, after.lon_deg))
        for number, chart in enumerate(self.maps):
            i = n + 2 * number
            phi[i, i] = 1.0
            q[i, i] = KINDS[chart.kind].bias_walk ** 2 * dt
            phi[i + 1, i + 1] = math.exp(-travelled / chart.error_length_m)
            q[i + 1, i + 1] = -math.expm1(-2.0 * travelled / chart.error_length_m) * chart.sigma**2
        return Transition(phi, q)


def check_bias_sigma(name: str, bias_sigma: Mapping[str, float]) -> None:
    """Raise ConfigError for what is no mapping, an unknown kind, or a sigma that is not >= 0."""
    if not isinstance(bias_sigma, Mapping):
        raise ConfigError(f"{name} bias_sigma is {bias_sigma!r}, expected a table of kinds such as {{terrain = 15.0}}")
    for kind, sigma in bias_sigma.items():
        if kind not in KINDS:
            unknown_name(f"kind in {name} bias_sigma", kind, KINDS)
        finite(f"{name} bias_sigma {kind}", sigma, minimum=0.0)


def _planar(ins: InsGrade, level: Level, dt: float) -> tuple[FloatArray, FloatArray]:
    """Transition and noise (n, n) of the inertial states that do not turn with the vehicle: both axes alike."""
    walk2 = ins.position_walk_m_per_sqrt_s**2
    speed2 = ins.velocity_walk_mps_per_sqrt_s**2 + (ins.accel_walk_mps_per_sqrt_h / 60.0) ** 2
    if level == "position":
        phi = np.array(((1.0, dt), (0.0, 1.0)))
        cross = 0.5 * speed2 * dt * dt
        q = np.array(((walk2 * dt + speed2 * dt**3 / 3.0, cross), (cross, speed2 * dt)))
    else:
        turn2 = (GRAVITY_MPS2 * math.radians(ins.gyro_walk_deg_per_sqrt_h) / 60.0) ** 2
        phi, q = discretised(_SCHULER_LOOP, np.sqrt(np.diag((walk2, speed2, turn2, 0.0))), dt)
    n = 2 * len(phi)
    phi2, q2 = np.zeros((n, n)), np.zeros((n, n))
    phi2[::2, ::2] = phi2[1::2, 1::2] = phi
    q2[::2, ::2] = q2[1::2, 1::2] = q
    return phi2, q2
