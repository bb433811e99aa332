"""What goes into the GNSS monitor, what it says, and what it remembers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

from terranav.core.records import Epoch
from terranav.ins.error_state import ErrorModel
from terranav.integrity.gnss_bank import Bank


class GnssStatus(StrEnum):
    """What is said of GNSS."""

    UNKNOWN = "unknown"  # it could be farther off than the limit, and nothing would show it
    CONSISTENT = "consistent"
    SUSPECT = "suspect"  # an alarm may follow
    SPOOFED = "spoofed"  # it is not where the vehicle is
    JAMMED = "jammed"  # there is none


ALARMS = (GnssStatus.SPOOFED, GnssStatus.JAMMED)


@dataclass(frozen=True, slots=True)
class GnssReading:
    """What a GNSS receiver said.

    Attributes
    ----------
    time_s : float
        When it was there, on the clock of the epochs.
    lat_deg, lon_deg : float
    sigma_m : float
        1-sigma per horizontal axis, as told [m].
    velocity_mps : (north, east) or None
    velocity_sigma_mps : float
    fix : bool
        Whether the receiver says that it has a position.
    """

    time_s: float
    lat_deg: float
    lon_deg: float
    sigma_m: float = 3.0
    velocity_mps: tuple[float, float] | None = None
    velocity_sigma_mps: float = 0.3
    fix: bool = True


@dataclass(frozen=True, slots=True)
class GnssVerdict:
    """What the monitor says.

    Attributes
    ----------
    status : GnssStatus
    since_s : float
        Time from which on it has said so [s].
    difference_m : float
        GNSS from the map-aided position, or where the map says nothing from what the INS made of the latest fix; NaN
        before GNSS was heard [m].
    threshold_m : float
        From there on that difference is an alarm [m].
    reasons : tuple of str
    """

    status: GnssStatus = GnssStatus.UNKNOWN
    since_s: float = math.nan
    difference_m: float = math.nan
    threshold_m: float = math.inf
    reasons: tuple[str, ...] = ("no GNSS heard yet",)


@dataclass(frozen=True, slots=True)
class GnssState:
    """State of the monitor after an epoch.

    Attributes
    ----------
    epoch : Epoch or None
        The latest.
    model : ErrorModel or None
    bank : Bank or None
    grounded : bool
        Whether there was a usable fix.
    first_s, time_s : float
        Of the first call and of the latest [s].
    velocity_mps : (north, east) or None
        Of the vehicle as the INS has it: told, else from its latest two positions [m/s].
    reading : GnssReading or None
        The latest with a position.
    followed_s : float
        When the bank last learned from one [s].
    gap_s : float
        Usual time between two [s].
    same : int
        Readings in a row with the very same position.
    same_s : float
        Time of the first of them [s].
    over : int
        Readings in a row beyond a limit.
    over_s : float
        Time of the first of them [s].
    calm_s : float
        From when on nothing has been suspect [s]; NaN when something is.
    agreed_s : float
        From when on the map has agreed with GNSS [s]; NaN when it does not.
    verdict : GnssVerdict
    """

    epoch: Epoch | None = None
    model: ErrorModel | None = None
    bank: Bank | None = None
    grounded: bool = False
    first_s: float = math.nan
    time_s: float = -math.inf
    velocity_mps: tuple[float, float] | None = None
    reading: GnssReading | None = None
    followed_s: float = -math.inf
    gap_s: float = math.nan
    same: int = 1
    same_s: float = math.nan
    over: int = 0
    over_s: float = math.nan
    calm_s: float = math.nan
    agreed_s: float = math.nan
    verdict: GnssVerdict = field(default_factory=GnssVerdict)
