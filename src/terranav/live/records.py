"""What travels through live mode: packets in, fixes and remarks out."""

from __future__ import annotations

from dataclasses import dataclass

from terranav.core.records import Estimate
from terranav.integrity.gnss_records import GnssVerdict


@dataclass(frozen=True, slots=True)
class Packet:
    """One message as it came in from a link, whole and unchanged.

    Attributes
    ----------
    stamp_us : int
        When it came in, in microseconds of the host's clock since 1970. Stamps of a recording are never reread from a
        clock, so that a replay gives the same bits.
    link : int
        Which of the input links, from 0.
    data : bytes
        One MAVLink frame, or one line of NMEA; anything else is remarked on and left out.
    """

    stamp_us: int
    link: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Fix:
    """What the engine says of one epoch; outputs send it only where it is usable and young enough.

    Attributes
    ----------
    stamp_us : int
        Host's time of the measurement (not of its arrival) [us since 1970].
    boot_us : int or None
        The same on the vehicle's clock, as far as it has one [us since it started].
    lat_deg, lon_deg : float
        Corrected position.
    alt_m : float
        Indicated altitude, above mean sea level for a vehicle that speaks MAVLink or NMEA [m].
    sigma_m : (north, east)
        1-sigma of the position [m], finite and above 0.
    velocity_mps : (north, east, down) or None
    attitude_deg : (roll, pitch, heading) or None
    estimate : Estimate
        All that the navigator says: status, protection level, reasons.
    usable : bool
        The estimate is usable and everything above is finite. Otherwise `withheld` says why not.
    withheld : tuple of str
    gnss : GnssVerdict or None
        What the GNSS monitor says at that epoch, None without one.
    """

    stamp_us: int
    boot_us: int | None
    lat_deg: float
    lon_deg: float
    alt_m: float
    sigma_m: tuple[float, float]
    velocity_mps: tuple[float, float, float] | None
    attitude_deg: tuple[float, float, float] | None
    estimate: Estimate
    usable: bool
    withheld: tuple[str, ...] = ()
    gnss: GnssVerdict | None = None


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that an operator should know, said once when it begins and once when it ends.

    Attributes
    ----------
    stamp_us : int
    level : str
        'info', 'warning' or 'error'.
    key : str
        What it is about, e.g. 'link 0 silent', 'clock step', 'map ends ahead'; stable, for programs.
    text : str
        In words, with figures.
    """

    stamp_us: int
    level: str
    key: str
    text: str
