"""The flight in files: truth and readings as a recording, telemetry as a .tlog."""

from __future__ import annotations

import math
from array import array
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from terranav.core.recording import ATTITUDE, REQUIRED, TRUTH, VELOCITY, Recording
from terranav.live.testbed.aircraft import AircraftState
from terranav.live.testbed.navigation import Known
from terranav.live.testbed.settings import FlightSettings
from terranav.live.testbed.telemetry import Told
from terranav.maps.map import Map

_COLUMNS = (*REQUIRED, *VELOCITY, *ATTITUDE, *TRUTH, "radar_altitude_m", "baro_altitude_m")


class Rows:
    """One row a tick: what the INS indicates, uncorrected, the truth, and the readings."""

    def __init__(self) -> None:
        self._values = array("d")

    def add(self, time_s: float, known: Known, told: Told, truth: AircraftState) -> None:
        """Append the row of one tick."""
        ins, reading = known.ins, told.range_m
        seen = reading if reading is not None and math.isfinite(reading) else math.nan
        self._values.extend((time_s, ins.lat_deg, ins.lon_deg, known.alt_m, *ins.velocity_mps, *ins.attitude_deg))
        self._values.extend((truth.lat_deg, truth.lon_deg, truth.alt_m, seen, known.pressure_alt_m))

    def recording(self, settings: FlightSettings, chart: Map) -> Recording:
        """All rows as a recording, with what is to be known of INS and sensors."""
        table = np.frombuffer(self._values, dtype=np.float64).reshape(-1, len(_COLUMNS))
        columns = {name: table[:, i].copy() for i, name in enumerate(_COLUMNS)}
        readings = columns["radar_altitude_m"]
        seen = readings[np.isfinite(readings)]
        sigma = {"baro_altitude_m": 5.0}
        if seen.size:
            sigma["radar_altitude_m"] = max(float(np.sqrt(np.mean(settings.altimeter.sigma(seen) ** 2))), 0.1)
        made = f"terranav fly, seed {settings.seed}, over {chart.name}; jsbsim's Cessna 172"
        datum = {} if chart.datum is None else {"all": chart.datum, "baro_altitude_m": "unknown"}
        return Recording(columns, settings.grade, sigma, {"made_by": made}, "fly", datum)


class Tlog:
    """A telemetry log: an 8-byte big-endian stamp [us since 1970] before every frame.

    Parameters
    ----------
    stream : binary file
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def add(self, time_us: int, frame: bytes) -> None:
        """Append one frame."""
        self._stream.write(time_us.to_bytes(8, "big") + frame)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()
