"""A flight over the sample map as an autopilot tells it: MAVLink frames with their stamps, and the truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from terranav.core.earth import offset_m, shift
from terranav.live.records import Fix, Packet
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

HOST_US = 1_700_000_000_000_000
BOOT_S = 100.0
FloatArray = NDArray[np.float64]


@cache
def chart() -> Map:
    """The map that comes with a dependency."""
    return sample_map()


@dataclass(frozen=True)
class Flight:
    """A flight in circles that widen, with a velocity error that the autopilot does not know of.

    Attributes
    ----------
    seconds, rate_hz : float
    seed : int
    drift_mps : (north, east)
        The error of the velocity that the autopilot tells.
    wind_mps : (north, east)
        Of the air that the airspeed is told in [m/s].
    system : int
    kind : int
        Of the altimeter: 0 laser, 3 radar.
    start_s : float
        What the vehicle's clock says at the start.
    course_deg : float
        At the start.
    """

    seconds: float = 120.0
    rate_hz: float = 10.0
    seed: int = 1
    drift_mps: tuple[float, float] = (0.6, -0.4)
    wind_mps: tuple[float, float] = (0.0, 0.0)
    system: int = 1
    kind: int = 3
    start_s: float = BOOT_S
    course_deg: float = 30.0
    clearance_m: float = 300.0
    truth: dict[str, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        t = np.arange(0.0, self.seconds, 1.0 / self.rate_hz)
        heading = np.radians(self.course_deg + 360.0 * t / 240.0 + 20.0 * np.sin(t / 17.0))
        speed = 45.0 + 3.0 * np.sin(t / 11.0)
        vn, ve = speed * np.cos(heading), speed * np.sin(heading)
        step = 1.0 / self.rate_hz
        north = np.concatenate([[0.0], np.cumsum(0.5 * (vn[1:] + vn[:-1]) * step)])
        east = np.concatenate([[0.0], np.cumsum(0.5 * (ve[1:] + ve[:-1]) * step)])
        lat, lon = shift(*chart().centre_deg, north - 500.0, east)
        ground = chart().sample(lat, lon)
        window = np.hanning(round(60.0 * self.rate_hz))
        padded = np.pad(ground, window.size // 2, mode="edge")
        alt = np.convolve(padded, window / window.sum(), mode="valid")[: t.size] + self.clearance_m
        nose = np.arctan2(ve - self.wind_mps[1], vn - self.wind_mps[0])
        truth = {
            "time_s": t, "lat_deg": lat, "lon_deg": lon, "alt_m": alt, "ground_m": ground, "vn": vn, "ve": ve,
            "vd": -np.gradient(alt, t), "roll": np.radians(15.0) * np.sin(t / 7.0), "heading": nose,
            "height_m": alt - ground + rng.normal(0.0, 2.0, t.size),
            "baro_m": alt + 23.0 + rng.normal(0.0, 0.5, t.size),
        }  # fmt: skip
        object.__setattr__(self, "truth", truth)

    def frames(self) -> Iterator[tuple[float, bytes]]:
        """Time since the start [s] and frame, in order."""
        link = dialect.MAVLink(None, srcSystem=self.system, srcComponent=1)
        true = self.truth
        drift = np.outer(true["time_s"], self.drift_mps)
        own_lat, own_lon = shift(true["lat_deg"], true["lon_deg"], drift[:, 0], drift[:, 1])
        for i, t in enumerate(true["time_s"].tolist()):
            for message in self._messages(i, (float(own_lat[i]), float(own_lon[i]))):
                yield t, bytes(message.pack(link))
                link.seq = (link.seq + 1) % 256

    def _messages(self, i: int, own: tuple[float, float]) -> Iterator[Any]:
        true = {key: float(values[i]) for key, values in self.truth.items()}
        ms = round((true["time_s"] + self.start_s) * 1000.0)
        if i % round(self.rate_hz) == 0:
            yield dialect.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
            yield dialect.MAVLink_system_time_message(HOST_US + ms * 1000, ms)
            yield dialect.MAVLink_gps_raw_int_message(
                ms * 1000, 3, round(true["lat_deg"] * 1e7), round(true["lon_deg"] * 1e7), round(true["alt_m"] * 1e3),
                80, 80, 4500, 0, 12,
            )  # fmt: skip
        roll, heading = true["roll"], true["heading"]
        yield dialect.MAVLink_attitude_message(ms, roll, 0.0, heading, 0.0, 0.0, 0.0)
        vn, ve = true["vn"] + self.drift_mps[0], true["ve"] + self.drift_mps[1]
        yield dialect.MAVLink_global_position_int_message(
            ms, round(own[0] * 1e7), round(own[1] * 1e7), round(true["alt_m"] * 1e3), 0,
            round(vn * 100.0), round(ve * 100.0), round(true["vd"] * 100.0), 65535,
        )  # fmt: skip
        hpa = 1013.25 * (1.0 - true["baro_m"] / 44330.77) ** (1.0 / 0.190263)
        yield dialect.MAVLink_scaled_pressure_message(ms, hpa, 0.0, 2000)
        slant = true["height_m"] / (math.cos(roll) if self.kind == 0 else 1.0)
        within = 1.0 < slant < 655.0
        yield dialect.MAVLink_distance_sensor_message(
            ms, 100, 65500, round(slant * 100.0) if within else 65500, self.kind, 0, 25, 255
        )
        wind = self.wind_mps
        through = math.hypot(true["vn"] - wind[0], true["ve"] - wind[1])
        calibrated = through * math.sqrt((1.0 - true["alt_m"] / 44330.77) ** 4.2559)
        yield dialect.MAVLink_vfr_hud_message(calibrated, 45.0, 0, 50, true["alt_m"], -true["vd"])

    def packets(self, link: int = 0, delay_s: float = 0.005) -> list[Packet]:
        """As they come in."""
        return [Packet(HOST_US + round((t + delay_s) * 1e6), link, frame) for t, frame in self.frames()]

    def error_m(self, fix: Fix) -> float:
        """How far a fix lies from the truth at its time [m]."""
        t = (fix.boot_us or 0) * 1e-6 - self.start_s
        return self.away_m(t, fix.lat_deg, fix.lon_deg)

    def away_m(self, t: float, lat_deg: float, lon_deg: float) -> float:
        """How far a place lies from the truth at a time since the start [m]."""
        true = self.truth
        lat = float(np.interp(t, true["time_s"], true["lat_deg"]))
        lon = float(np.interp(t, true["time_s"], true["lon_deg"]))
        north, east = offset_m(lat, lon, lat_deg, lon_deg)
        return float(np.hypot(north, east))
