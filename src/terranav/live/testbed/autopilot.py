"""A small autopilot: it follows legs and heights by position, velocity and attitude as the vehicle believes them.

Cascades of proportional loops with limits, integrals where a constant error would stay:

    across track -> course -> bank -> aileron            (the turn is coordinated by the fin; the rudder damps)
    height -> climb rate -> pitch -> elevator            (pitch is trimmed by the integral of the climb rate's error)
    airspeed -> throttle                                 (trimmed by its own integral)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

CLIMB_MPS, SINK_MPS = 3.0, 4.0  # at most
BANK_DEG = 30.0  # at most
_SLOWEST_MPS = 36.0  # below it nothing climbs
_CAPTURE_M = 600.0  # across track: from here the leg is met at 45 degrees


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the autopilot steers for: a course line, a height and a speed.

    Attributes
    ----------
    course_deg : float
        Of the leg.
    across_m : float
        How far the vehicle believes to be to the right of it [m].
    alt_m : float
        Height above mean sea level [m].
    climb_mps : float
        Slope of the planned heights, fed forward [m/s].
    airspeed_mps : float
        True airspeed.
    """

    course_deg: float
    across_m: float
    alt_m: float
    climb_mps: float
    airspeed_mps: float


@dataclass(frozen=True, slots=True)
class Felt:
    """What the autopilot knows of the vehicle.

    Attributes
    ----------
    velocity_mps : (north, east, down)
    attitude_deg : (roll, pitch, heading)
    rates_radps : (x, y, z)
    alt_m, airspeed_mps : float
    """

    velocity_mps: tuple[float, float, float]
    attitude_deg: tuple[float, float, float]
    rates_radps: tuple[float, float, float]
    alt_m: float
    airspeed_mps: float


class Autopilot:
    """The loops and their integrals.

    Parameters
    ----------
    trim_pitch_deg, trim_throttle : float
        Of level flight, where the integrals start.
    """

    def __init__(self, trim_pitch_deg: float, trim_throttle: float) -> None:
        self._pitch_deg, self._throttle, self._aileron = trim_pitch_deg, trim_throttle, 0.0

    def controls(self, wanted: Wanted, felt: Felt, dt_s: float) -> tuple[float, float, float, float]:
        """Elevator, aileron, rudder and throttle, for `Aircraft.steer`, after dt_s more."""
        roll, pitch, _ = felt.attitude_deg
        roll_rate, pitch_rate, yaw_rate = (math.degrees(rate) for rate in felt.rates_radps)
        bank = self._bank(wanted, felt)
        if abs(bank - roll) < 5.0:  # the engine's torque wants a little aileron all the time
            self._aileron = min(max(self._aileron + 0.004 * (bank - roll) * dt_s, -0.15), 0.15)
        aileron = self._aileron + 0.02 * (bank - roll) - 0.008 * roll_rate
        climb = wanted.climb_mps + 0.15 * (wanted.alt_m - felt.alt_m)
        climb = min(max(climb, -SINK_MPS), CLIMB_MPS)
        if felt.airspeed_mps < _SLOWEST_MPS:
            climb = min(climb, 0.0)
        lacking = climb + felt.velocity_mps[2]
        pace = min(max(0.25 * lacking, -0.75), 0.75)
        self._pitch_deg = min(max(self._pitch_deg + pace * dt_s, -8.0), 12.0)
        pull = 2.0 * (1.0 / max(math.cos(math.radians(roll)), 0.7) - 1.0) * 5.0  # a turn wants more lift
        aim = min(max(self._pitch_deg + 0.9 * lacking + pull, -12.0), 14.0)
        elevator = -0.06 * (aim - pitch) + 0.02 * pitch_rate
        slow = wanted.airspeed_mps - felt.airspeed_mps
        if 0.0 < self._throttle + 0.08 * slow < 1.0:
            self._throttle += 0.01 * slow * dt_s
        throttle = self._throttle + 0.08 * slow + 0.05 * climb
        return elevator, aileron, -0.01 * yaw_rate + 0.01 * math.degrees(_turn_rate(roll, felt)), throttle

    @staticmethod
    def _bank(wanted: Wanted, felt: Felt) -> float:
        """Bank that turns the track towards the leg [deg]."""
        course = math.degrees(math.atan2(felt.velocity_mps[1], felt.velocity_mps[0]))
        cut = math.degrees(math.atan(wanted.across_m / _CAPTURE_M))
        off = (wanted.course_deg - cut - course + 180.0) % 360.0 - 180.0
        return min(max(1.2 * off, -BANK_DEG), BANK_DEG)


def _turn_rate(roll_deg: float, felt: Felt) -> float:
    """Rate about the body's z axis of a coordinated turn at this bank [rad/s]."""
    return 9.80665 * math.sin(math.radians(roll_deg)) / max(felt.airspeed_mps, 20.0)
