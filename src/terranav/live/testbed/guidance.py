"""Which way the vehicle wants to go, by where it believes to be."""

from __future__ import annotations

import math

from terranav.core.earth import GRAVITY_MPS2
from terranav.live.testbed.autopilot import Wanted
from terranav.live.testbed.course import Course
from terranav.live.testbed.inertial import Indicated

_BANK_DEG, _ROLL_IN_S = 25.0, 3.0  # of the turns that are planned at waypoints
_LOW_M, _PULL_UP_M, _PULL_UP_MPS = 90.0, 60.0, 3.0


class Guidance:
    """Follows a course leg by leg; turns are flown by their waypoints, not over them.

    Parameters
    ----------
    course : Course
    airspeed_mps : float
    """

    def __init__(self, course: Course, airspeed_mps: float) -> None:
        self.course, self.leg = course, 0
        self._airspeed = airspeed_mps

    def wanted(self, own: Indicated, alt_m: float, range_m: float | None) -> Wanted:
        """What to steer for.

        Parameters
        ----------
        own : Indicated
            Where the vehicle believes to be.
        alt_m : float
            Its height [m].
        range_m : float or None
            What the altimeter reads: below 90 m the ground comes before the plan.
        """
        course, place = self.course, (own.lat_deg, own.lon_deg)
        speed = math.hypot(*own.velocity_mps[:2])
        heading, across, along, to_go = course.leg(self.leg, place)
        while to_go < self._early_m(speed) and self.leg + 2 < len(course.places):
            self.leg += 1
            heading, across, along, to_go = course.leg(self.leg, place)
        planned, slope = course.height(float(course.along_m[self.leg]) + along)
        climb = slope * speed
        if range_m is not None and range_m < _LOW_M:
            planned, climb = max(planned, alt_m + _PULL_UP_M), _PULL_UP_MPS
        return Wanted(heading, across, planned, climb, self._airspeed)

    def off_track_m(self, lat_deg: float, lon_deg: float) -> float:
        """How far a place lies beside the leg that is flown [m]."""
        return abs(self.course.leg(self.leg, (lat_deg, lon_deg))[1])

    def _early_m(self, speed_mps: float) -> float:
        """How far before the waypoint the turn begins [m]."""
        radius = speed_mps**2 / (GRAVITY_MPS2 * math.tan(math.radians(_BANK_DEG)))
        half = 0.5 * min(self.course.turn_deg(self.leg), 120.0)
        return radius * math.tan(math.radians(half)) + _ROLL_IN_S * speed_mps
