"""What an estimator is told of the INS, and how such an INS's position error grows.

Short-term error model of an unaided INS on one horizontal axis (e.g. Groves, Principles of GNSS, Inertial and
Multisensor Integrated Navigation Systems, 2nd ed., section 5.7, undamped Schuler loop of rate w = sqrt(g/R)):

    velocity error:  v0 cos(wt)  +  (b_a + g phi) sin(wt)/w  +  g b_g (1 - cos(wt))/w^2  +  random walk

Only its standard deviation is used here, as an envelope that never shrinks: sin and 1 - cos are held at their first
maximum, v0 at its start, and the random walk grows as if no loop held it. What the loop makes of each part is drawn in
`terranav.ins.drift` and followed by `terranav.ins.error_state`. A grade without figures of its inertial sensors states
its errors on position level and has no loop: v0 is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from terranav.core.checks import finite
from terranav.core.earth import GRAVITY_MPS2, SCHULER_RAD_PER_S


@dataclass(frozen=True)
class InsGrade:
    """Quality of an inertial navigation system: 1-sigma values per horizontal axis.

    Attributes
    ----------
    position_sigma_m : float
        Initial position error [m], > 0.
    velocity_sigma_mps : float
        Initial velocity error, constant unless the fields below make it grow [m/s].
    position_walk_m_per_sqrt_s : float
        Random walk of the position error [m/sqrt(s)].
    velocity_walk_mps_per_sqrt_s : float
        Random walk of the velocity error [m/s/sqrt(s)].
    attitude_sigma_deg, heading_sigma_deg : float
        Initial tilt per axis and initial heading error [deg].
    gyro_bias_sigma_deg_per_h, accel_bias_sigma_ug : float
        Biases, constant over the run [deg/h], [micro-g].
    gyro_walk_deg_per_sqrt_h, accel_walk_mps_per_sqrt_h : float
        Angular and velocity random walk of the sensors [deg/sqrt(h)], [m/s/sqrt(h)].
    name : str
        Of the grade, for reports.

    Raises
    ------
    ConfigError
        When a value is negative or not finite; position_sigma_m must be positive.
    """

    position_sigma_m: float = 500.0
    velocity_sigma_mps: float = 0.5
    position_walk_m_per_sqrt_s: float = 1.0
    velocity_walk_mps_per_sqrt_s: float = 0.0
    attitude_sigma_deg: float = 0.0
    heading_sigma_deg: float = 0.0
    gyro_bias_sigma_deg_per_h: float = 0.0
    accel_bias_sigma_ug: float = 0.0
    gyro_walk_deg_per_sqrt_h: float = 0.0
    accel_walk_mps_per_sqrt_h: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        for entry in fields(self):
            if entry.name != "name":
                above = 0.0 if entry.name == "position_sigma_m" else -math.inf
                value = finite(f"ins {entry.name}", getattr(self, entry.name), minimum=0.0, above=above)
                object.__setattr__(self, entry.name, value)

    @property
    def has_schuler_loop(self) -> bool:
        """Whether tilt, biases or the gyros' random walk are stated: then velocity errors swing at the Schuler rate.

        Without them the grade is on position level: the velocity error is constant but for its walk.
        """
        figures = (self.attitude_sigma_deg, self.accel_bias_sigma_ug, self.gyro_bias_sigma_deg_per_h)
        return any(figures) or self.gyro_walk_deg_per_sqrt_h > 0.0

    def velocity_sigma_at_mps(self, elapsed_s: float) -> float:
        """1-sigma of the velocity error per axis after `elapsed_s` without aiding [m/s] (see the module docstring)."""
        walks = self.velocity_walk_mps_per_sqrt_s or self.accel_walk_mps_per_sqrt_h or self.gyro_walk_deg_per_sqrt_h
        if not (walks or self.accel_bias_sigma_ug or self.attitude_sigma_deg or self.gyro_bias_sigma_deg_per_h):
            return self.velocity_sigma_mps  # most grades on position level: nothing makes it grow
        w, t = SCHULER_RAD_PER_S, elapsed_s
        tilt_mps2 = GRAVITY_MPS2 * math.radians(self.attitude_sigma_deg)
        accel_mps2 = GRAVITY_MPS2 * 1e-6 * self.accel_bias_sigma_ug
        gyro_mps3 = GRAVITY_MPS2 * math.radians(self.gyro_bias_sigma_deg_per_h) / 3600.0
        gyro_walk = GRAVITY_MPS2 * math.radians(self.gyro_walk_deg_per_sqrt_h) / 60.0  # [m/s^2/sqrt(s)]
        walk_var = self.velocity_walk_mps_per_sqrt_s**2 + (self.accel_walk_mps_per_sqrt_h / 60.0) ** 2
        sine = math.sin(min(w * t, math.pi / 2)) / w
        return math.sqrt(
            self.velocity_sigma_mps**2
            + walk_var * t
            + (tilt_mps2**2 + accel_mps2**2) * sine**2
            + (gyro_mps3 * (1.0 - math.cos(min(w * t, math.pi))) / w**2) ** 2
            + gyro_walk**2 * max(0.5 * t - 0.25 * math.sin(2.0 * w * t) / w, 0.0) / w**2
        )

    def position_growth_m2(self, elapsed_s: float, dt_s: float, variance_m2: float = math.inf) -> float:
        """Variance that the position error of one axis gains between `elapsed_s` and `elapsed_s + dt_s` [m^2].

        A drift is no white noise: a filter without a velocity state that averages readings over a time T lags a drift
        v by v T. The growth returned is that of an INS last known T ago, walk^2 dt + sigma_v^2 ((T + dt)^2 - T^2), T
        being the time in which its drift would have filled the present variance, walk^2 T + sigma_v^2 T^2 = variance,
        but no longer than the drift since the start takes at the present speed. So the variance settles where the lag
        is one sigma, and without readings it grows as that of the unaided INS, with t^2.

        Parameters
        ----------
        elapsed_s : float
            Time since the start of the run, when the INS was known to its initial sigmas [s].
        dt_s : float
            Step, >= 0 [s].
        variance_m2 : float
            Present variance of the axis [m^2]; infinite for an INS that nothing corrects.
        """
        walk2, speed = self.position_walk_m_per_sqrt_s**2, self.velocity_sigma_at_mps(elapsed_s + dt_s)
        if speed == 0.0:
            return walk2 * dt_s
        start, middle = (self.velocity_sigma_at_mps(part * elapsed_s) for part in (0.0, 0.5))
        since = elapsed_s * (start + 4.0 * middle + speed) / (6.0 * speed)  # of a drift at this speed: Simpson's rule
        if math.isfinite(variance_m2):
            spread = walk2 + math.sqrt(walk2 * walk2 + 4.0 * speed * speed * variance_m2)
            since = min(since, 2.0 * variance_m2 / spread) if spread > 0.0 else 0.0
        return walk2 * dt_s + speed * speed * (2.0 * since + dt_s) * dt_s
