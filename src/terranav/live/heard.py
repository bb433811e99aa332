"""What was heard in a message, whatever the wire format: plain numbers, checked against what can be.

Times are on the clock of the sender, None where the message has none: it then counts from when it came in.
"""

from __future__ import annotations

from dataclasses import dataclass

LAT_DEG, LON_DEG, ALT_M = (-90.0, 90.0), (-180.0, 360.0), (-12000.0, 100000.0)


@dataclass(frozen=True, slots=True)
class Position:
    """The vehicle's own position [deg], altitude [m] or None."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None


@dataclass(frozen=True, slots=True)
class Velocity:
    """North, east, down [m/s]; `source` is the message, of which one is used at a time."""

    north_mps: float
    east_mps: float
    down_mps: float
    source: str


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll, pitch, heading [deg]; None is not told."""

    roll_deg: float | None
    pitch_deg: float | None
    heading_deg: float


@dataclass(frozen=True, slots=True)
class AirData:
    """Speed through the air or the water along the heading, and across to starboard [m/s]; the air's is calibrated."""

    speed_mps: float
    across_mps: float = 0.0
    calibrated: bool = True


@dataclass(frozen=True, slots=True)
class Ground:
    """Speed over ground along the heading and across to starboard [m/s]."""

    along_mps: float
    across_mps: float


@dataclass(frozen=True, slots=True)
class Altitude:
    """Altitude above mean sea level that comes apart from a position [m]."""

    alt_m: float


@dataclass(frozen=True, slots=True)
class Pressure:
    """Pressure altitude, with any constant offset [m]; `source` is the message, of which one is used at a time."""

    altitude_m: float
    source: str


@dataclass(frozen=True, slots=True)
class Range:
    """What a sensor that looks down measured [m], None where it said that it has nothing; `kind` laser or radar."""

    kind: str
    sensor: str
    range_m: float | None


@dataclass(frozen=True, slots=True)
class Depth:
    """Water below the surface, or below the transducer where nothing tells how deep that is [m]."""

    depth_m: float
    from_surface: bool


@dataclass(frozen=True, slots=True)
class Gnss:
    """A receiver's word, for monitors and scores; it never reaches the navigator.

    `fix` is the MAVLink fix type (3 and more: three dimensions); positions [deg], [m], sigma [m], velocity [m/s] may be
    None.
    """

    fix: int
    lat_deg: float
    lon_deg: float
    alt_m: float | None
    sigma_m: float | None
    velocity_mps: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Beat:
    """A vehicle says that it is there: MAVLink's numbers of autopilot and type."""

    autopilot: int
    type: int


@dataclass(frozen=True, slots=True)
class UnixTime:
    """UTC as the vehicle knows it [us since 1970]."""

    unix_us: int


Word = Position | Velocity | Attitude | AirData | Ground | Altitude | Pressure | Range | Depth | Gnss | Beat | UnixTime


@dataclass(frozen=True, slots=True)
class Heard:
    """One message.

    Attributes
    ----------
    name : str
        Of the message in its format.
    sender : (int, int)
        MAVLink system and component; (0, 0) for NMEA.
    sequence : int or None
        The sender's counter, 0 to 255, for counting losses.
    clock_s : float or None
        The sender's clock [s].
    steady : bool
        That clock is the one by which the sender is followed; else it may be another (microseconds since 1970).
    words : tuple of Word
        What it says.
    rejected : tuple of str
        The fields that cannot be, in words.
    """

    name: str
    sender: tuple[int, int] = (0, 0)
    sequence: int | None = None
    clock_s: float | None = None
    steady: bool = True
    words: tuple[Word, ...] = ()
    rejected: tuple[str, ...] = ()
