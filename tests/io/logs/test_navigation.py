"""From a log to a fix: an ArduPilot log over real ground, GNSS taken away, held by the map."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import terranav as tn
from terranav.core.earth import shift
from terranav.core.errors import DataWarning
from terranav.io.logs import open_log
from tests.io.logs.flights import Flight, dataflash


def test_a_log_with_its_gnss_taken_away_is_held_by_the_map(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    dem = tn.sample_map()
    south, west, north, east = 36.45, -84.4, 36.7, -84.1
    time_s = np.arange(6000) / 10.0
    lat, lon = shift(
        np.full(6000, south + 0.1 * (north - south)),
        np.full(6000, west + 0.2 * (east - west)),
        25 * time_s,
        20 * time_s,
    )
    ground = np.asarray(dem.sample(lat, lon), dtype=np.float64)
    assert np.isfinite(ground).all()
    noise = np.random.default_rng(5).normal(0.0, 1.0, 6000)
    alt = np.full(6000, ground.max() + 80.0)
    made = Flight(time_s, lat, lon, alt, ground + noise, np.zeros(6000))
    file = tmp_path / "00000001.BIN"
    file.write_bytes(dataflash(made, max_m=600.0))
    log = open_log(file, rate_hz=1.0)
    assert log.facts["altimeters"]["laser"]["covers"] > 0.8
    grade = tn.InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.3)
    flown = tn.add_drift(log.recording, grade, 2)  # the first seed whose INS ends more than 200 m off
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", DataWarning)
        result = tn.run("marginalized", flown, maps=[dem], seed=4)
    assert any("mean sea level and NAVD 88 differ by a metre or two" in str(one.message) for one in told)
    held, alone = np.hypot(*result.error_m.T)[-200:], np.hypot(*flown.ins_error_m().T)[-200:]
    assert any("mean sea level and NAVD 88 differ by a metre or two" in str(one.message) for one in told)
    assert np.median(alone) > 200.0
    assert np.median(held) < 60.0
