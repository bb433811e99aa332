"""The aircraft: JSBSim's Cessna 172, flown by four controls. JSBSim stays silent and writes no file."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from typing import Any

from terranav.core.earth import GRAVITY_MPS2
from terranav.core.errors import ConfigError

Triple = tuple[float, float, float]

STEP_HZ = 120
_MODEL = "c172p"
_FT = 0.3048
_STATE = (
    "position/lat-geod-deg", "position/long-gc-deg", "position/geod-alt-ft",
    "velocities/v-north-fps", "velocities/v-east-fps", "velocities/v-down-fps",
    "attitude/phi-deg", "attitude/theta-deg", "attitude/psi-deg",
    "velocities/p-rad_sec", "velocities/q-rad_sec", "velocities/r-rad_sec",
    "accelerations/n-pilot-x-norm", "accelerations/n-pilot-y-norm", "accelerations/n-pilot-z-norm",
    "velocities/vt-fps", "velocities/ve-kts", "fcs/throttle-cmd-norm",
)  # fmt: skip
_CONTROLS = ("fcs/elevator-cmd-norm", "fcs/aileron-cmd-norm", "fcs/rudder-cmd-norm", "fcs/throttle-cmd-norm")
_WIND = ("atmosphere/wind-north-fps", "atmosphere/wind-east-fps")


@dataclass(frozen=True, slots=True)
class AircraftState:
    """Where the aircraft truly is and how it moves.

    Attributes
    ----------
    lat_deg, lon_deg : float
        Geodetic, WGS-84.
    alt_m : float
        Above mean sea level, which is taken for the ellipsoid [m].
    velocity_mps : (north, east, down)
        Over ground.
    attitude_deg : (roll, pitch, heading)
    rates_radps : (x, y, z)
        Of turn, body axes.
    force_mps2 : (x, y, z)
        Specific force in body axes: what accelerometers feel.
    airspeed_mps : float
        True airspeed.
    equivalent_mps : float
        Equivalent airspeed, which a pitot tube measures.
    throttle : float
        0..1.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_mps: Triple
    attitude_deg: Triple
    rates_radps: Triple
    force_mps2: Triple
    airspeed_mps: float
    equivalent_mps: float
    throttle: float


class Aircraft:
    """One aircraft in the air, in trim where it starts.

    Parameters
    ----------
    lat_deg, lon_deg, alt_m, heading_deg, airspeed_mps : float
        Where and how it starts; true airspeed.

    Raises
    ------
    ConfigError
        JSBSim is not installed.
    """

    def __init__(self, lat_deg: float, lon_deg: float, alt_m: float, heading_deg: float, airspeed_mps: float) -> None:
        jsbsim = _library()
        self._fdm: Any = jsbsim.FGFDMExec(None)
        self._fdm.set_debug_level(0)
        self._fdm.disable_output()  # before the model is read: it asks for a file of its own
        self._fdm.load_model(_MODEL)
        self._fdm.set_dt(1.0 / STEP_HZ)
        start = {
            "ic/terrain-elevation-ft": 0.0, "ic/lat-geod-deg": lat_deg, "ic/long-gc-deg": lon_deg,
            "ic/h-sl-ft": alt_m / _FT, "ic/psi-true-deg": heading_deg, "ic/vt-fps": airspeed_mps / _FT,
            "ic/gamma-deg": 0.0,
        }  # fmt: skip
        for key, value in start.items():
            self._fdm[key] = value
        self._begin()
        try:
            self._fdm["simulation/do_simple_trim"] = 1
        except jsbsim.TrimFailureError:  # it gives up now and then, next to a solution: the autopilot finds it
            self._begin()
        manager = self._fdm.get_property_manager()
        self._state = [manager.get_node(name).get_double_value for name in _STATE]
        self._controls = [manager.get_node(name).set_double_value for name in _CONTROLS]
        self._wind = [manager.get_node(name).set_double_value for name in _WIND]
        self.trim_pitch_deg = float(self._fdm["attitude/theta-deg"])
        self.trim_throttle = float(self._fdm["fcs/throttle-cmd-norm"])

    def _begin(self) -> None:
        """Put the aircraft into the air with its engine running."""
        self._fdm.run_ic()
        self._fdm["propulsion/fuel_freeze"] = 1.0  # as long a flight as one likes
        self._fdm["propulsion/set-running"] = -1
        self._fdm["fcs/mixture-cmd-norm"] = 0.9
        self._fdm["fcs/throttle-cmd-norm"] = 0.7

    @property
    def state(self) -> AircraftState:
        """The present state."""
        values = [get() for get in self._state]
        gravity = GRAVITY_MPS2
        return AircraftState(
            values[0],
            values[1],
            values[2] * _FT,
            (values[3] * _FT, values[4] * _FT, values[5] * _FT),
            (values[6], values[7], values[8] % 360.0),
            (values[9], values[10], values[11]),
            (values[12] * gravity, values[13] * gravity, values[14] * gravity),
            values[15] * _FT,
            values[16] * 1852.0 / 3600.0,
            values[17],
        )

    def steer(self, elevator: float, aileron: float, rudder: float, throttle: float) -> None:
        """Set the controls: -1..1 each (elevator up is negative), the throttle 0..1; what is beyond is cut."""
        for put, value, low in zip(self._controls, (elevator, aileron, rudder, throttle), (-1, -1, -1, 0), strict=True):
            put(min(max(value, low), 1.0))

    def blow(self, north_mps: float, east_mps: float) -> None:
        """Set the wind: the velocity of the air over ground [m/s]."""
        self._wind[0](north_mps / _FT)
        self._wind[1](east_mps / _FT)

    def step(self, count: int) -> None:
        """Fly on for so many steps of 1/120 s."""
        for _ in range(count):
            self._fdm.run()
        if not math.isfinite(self._state[2]()):
            raise RuntimeError("the flight dynamics came to no number")  # no input can do that: a bug


def _library() -> Any:
    """JSBSim without a word on the terminal."""
    try:
        jsbsim = importlib.import_module("jsbsim")
    except ImportError:
        raise ConfigError(
            "the flying test bed needs jsbsim, which is not installed: pip install terranav[fly]"
        ) from None
    if not hasattr(jsbsim, "set_logger"):
        raise ConfigError("the flying test bed needs jsbsim 1.3 or newer: pip install --upgrade terranav[fly]")

    class Silent(jsbsim.FGLogger):  # type: ignore[name-defined, misc]
        """A logger that says nothing."""

        def message(self, message: str) -> None:
            """Leave it."""

        set_level = format = message

        def file_location(self, filename: str, line: int) -> None:
            """Leave it."""

        def flush(self) -> None:
            """Leave it."""

    jsbsim.set_logger(Silent())
    return jsbsim
