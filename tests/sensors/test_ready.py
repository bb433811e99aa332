"""Raw readings to terrain measurements: exact without noise, honest sigmas, the same bits live and replayed."""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import ConfigError
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Measurement
from terranav.sensors.altimeter import Altimeter, slant_factor
from terranav.sensors.barometer import Barometer
from terranav.sensors.ready import ReadyState, made_ready, ready


def radar(value: float, sigma: float = 3.0) -> Measurement:
    return Measurement("radar_altitude", value, sigma)


def laser(value: float, sigma: float = 1.0) -> Measurement:
    return Measurement("laser_altitude", value, sigma)


def baro(value: float, sigma: float = 4.0) -> Measurement:
    return Measurement("baro_altitude", value, sigma)


def epoch(time_s: float, *measurements: Measurement, alt_m: float = 1500.0) -> Epoch:
    return Epoch(time_s, 46.0, 7.0, alt_m, measurements=measurements)


def one(value: Epoch, **settings: float) -> Epoch:
    (out,) = ready([value], **settings)
    return out


@given(seed=st.integers(0, 1000), kind=st.sampled_from(["radar", "laser"]))
def test_noiseless_sensors_give_the_exact_terrain(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    n = 30
    terrain, altitude = rng.uniform(0.0, 900.0, n), rng.uniform(1000.0, 2000.0, n)
    roll, pitch = rng.uniform(-30.0, 30.0, n), rng.uniform(-10.0, 10.0, n)
    sensor = Altimeter(kind=kind)
    reach = (altitude - terrain) / (slant_factor(roll, pitch) if kind == "laser" else 1.0)
    rec = Recording(
        {
            "time_s": np.arange(float(n)), "lat_deg": np.full(n, 46.0), "lon_deg": np.full(n, 7.0), "alt_m": altitude,
            "roll_deg": roll, "pitch_deg": pitch, "heading_deg": np.zeros(n),
            sensor.column: sensor.measure(reach, rng), "baro_altitude_m": Barometer().measure(altitude, rng),
        }
    )  # fmt: skip
    readings = [e.measurements for e in ready(rec.epochs())]
    assert all(len(m) == 1 and m[0].kind == "terrain" for m in readings)
    np.testing.assert_allclose([m[0].value for m in readings], terrain, atol=1e-9)


def test_sigma_is_the_root_sum_of_squares() -> None:
    out = one(epoch(0.0, radar(1000.0, 3.0), baro(1500.0, 4.0)))
    assert out.measurements == (Measurement("terrain", 500.0, 5.0),)


def test_an_older_barometer_is_carried_on_by_the_indicated_altitude() -> None:
    first, second = epoch(0.0, baro(1510.0)), epoch(1.5, radar(1000.0), alt_m=1503.0)
    out = list(ready([first, second]))
    assert out[0].measurements == ()
    assert out[1].measurements == (Measurement("terrain", 513.0, 5.0),)


def test_too_old_a_barometer_gives_way_to_the_indicated_altitude() -> None:
    stream = [epoch(0.0, baro(1510.0)), epoch(2.5, radar(1000.0))]
    assert list(ready(stream))[1].measurements == (Measurement("terrain", 500.0, math.hypot(5.0, 3.0)),)
    assert list(ready(stream, max_age_s=3.0))[1].measurements[0].value == 510.0
    assert list(ready(stream, alt_sigma_m=4.0))[1].measurements[0].sigma == 5.0


def test_laser_is_preferred_and_made_vertical() -> None:
    level = one(epoch(0.0, radar(900.0), laser(1000.0), baro(1500.0)))
    assert [m.value for m in level.measurements] == [500.0]
    banked = one(replace(epoch(0.0, laser(1000.0), baro(1500.0)), attitude_deg=(60.0, 0.0, 90.0)))
    assert banked.measurements[0].value == pytest.approx(1000.0)
    assert banked.measurements[0].sigma == pytest.approx(math.hypot(4.0, 0.5))


def test_other_measurements_stay_in_order() -> None:
    gravity, magnetic = Measurement("gravity", 12.0, 1.0), Measurement("magnetic", 50.0, 9.0)
    out = one(epoch(0.0, gravity, radar(1000.0), magnetic, baro(1500.0)))
    assert [m.kind for m in out.measurements] == ["gravity", "magnetic", "terrain"]


def test_ready_epochs_pass_as_they_are() -> None:
    terrain = Measurement("terrain", 480.0, 2.0)
    empty, done = epoch(0.0), epoch(1.0, terrain)
    out = list(ready([empty, done]))
    assert out[0] is empty
    assert out[1] is done
    assert one(epoch(2.0, radar(1000.0), terrain, baro(1500.0))).measurements == (terrain,)


def test_readings_that_are_not_finite_are_no_readings() -> None:
    assert one(epoch(0.0, radar(math.nan), baro(1500.0))).measurements == ()
    assert one(epoch(0.0, radar(math.inf))).measurements == ()


def test_a_live_stream_and_its_replay_give_the_same_bits() -> None:
    rng = np.random.default_rng(8)
    epochs = []
    for i in range(50):
        height = [baro(rng.normal(1500.0, 4.0))] if i % 3 == 0 else []
        clearance = [radar(rng.normal(900.0, 9.0))] if i % 2 else []
        epochs.append(epoch(0.7 * i, *height, *clearance))

    def live() -> Iterator[Epoch]:
        yield from epochs

    assert list(ready(live())) == list(ready(epochs))
    assert list(ready(epochs))[:20] == list(ready(epochs[:20]))


@pytest.mark.parametrize("settings", [{"max_age_s": -1.0}, {"alt_sigma_m": 0.0}])
def test_impossible_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        one(epoch(0.0), **settings)


def test_a_stopped_stream_goes_on_with_the_same_bits() -> None:
    rng = np.random.default_rng(2)
    stream = [
        epoch(float(i), *([baro(1500.0 + i)] if i % 3 == 0 else []), laser(float(h)), alt_m=1500.0 + 0.5 * i)
        for i, h in enumerate(rng.uniform(100.0, 300.0, 20))
    ]
    whole = list(ready(stream))
    state, parts = ReadyState(), []
    for one_epoch in stream:
        state, made = made_ready(pickle.loads(pickle.dumps(state)), one_epoch)
        parts.append(made)
    assert parts == whole
    with pytest.raises(ConfigError, match="max_age_s"):
        ReadyState(max_age_s=-1.0)
