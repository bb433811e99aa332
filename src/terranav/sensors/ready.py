"""Raw readings turned into what compares with a map: terrain height = altitude - clearance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from terranav.core.checks import finite
from terranav.core.frozen import changed
from terranav.core.recording import DEFAULT_RAW_SIGMA_M
from terranav.core.records import Epoch, Measurement
from terranav.sensors.altimeter import slant_factor

RAW_KINDS = ("radar_altitude", "laser_altitude", "baro_altitude")
MAX_AGE_S = 2.0


def ready(
    epochs: Iterable[Epoch],
    *,
    max_age_s: float = MAX_AGE_S,
    alt_sigma_m: float = DEFAULT_RAW_SIGMA_M["baro_altitude_m"],
) -> Iterator[Epoch]:
    """Turn the altimeter readings of a stream into terrain measurements.

    An epoch with an altimeter reading gets a Measurement of kind 'terrain': value = altitude - clearance, its variance
    the sum of both. The altitude is the barometer's at this epoch; else its latest, not older than `max_age_s`, carried
    on by the change of the indicated altitude; else the indicated altitude with `alt_sigma_m`. A laser's slant range is
    made vertical with the attitude, where that is known; a radar altimeter needs no such step (see
    `terranav.sensors.altimeter`). With both, the laser counts alone: it sees the ground below and not the nearest, and
    two measurements that share one altitude error would be taken for independent. Raw readings do not leave this
    function; an epoch that already has a terrain measurement keeps it and gets no second.

    It looks at the past only, so a live stream and its replay give the same bits.

    Parameters
    ----------
    epochs : iterable of Epoch, in the order of time
    max_age_s : float
        Oldest barometer reading that still counts [s].
    alt_sigma_m : float
        1-sigma of the indicated altitude where it stands in for a barometer [m], > 0.

    Yields
    ------
    Epoch
        One for each; the very same object where it holds no raw reading.

    Raises
    ------
    ConfigError
        For an impossible setting, when the first epoch is asked for.
    """
    state = ReadyState(max_age_s, alt_sigma_m)
    for epoch in epochs:
        state, made = made_ready(state, epoch)
        yield made


@dataclass(frozen=True, slots=True)
class ReadyState:
    """What `ready` knows between two epochs, so that a live stream can be stopped and resumed.

    Attributes
    ----------
    max_age_s, alt_sigma_m : float
        As in `ready`.
    barometer : (Epoch, Measurement) or None
        Its latest reading, and the epoch that had it.

    Raises
    ------
    ConfigError
        For an impossible setting.
    """

    max_age_s: float = MAX_AGE_S
    alt_sigma_m: float = DEFAULT_RAW_SIGMA_M["baro_altitude_m"]
    barometer: tuple[Epoch, Measurement] | None = None

    def __post_init__(self) -> None:
        finite("ready max_age_s", self.max_age_s, minimum=0.0)
        finite("ready alt_sigma_m", self.alt_sigma_m, above=0.0)


def made_ready(state: ReadyState, epoch: Epoch) -> tuple[ReadyState, Epoch]:
    """One step of `ready`: the state after an epoch, and the epoch made ready."""
    raw = {m.kind: m for m in epoch.measurements if m.kind in RAW_KINDS and math.isfinite(m.value)}
    if "baro_altitude" in raw:
        state = changed(state, barometer=(epoch, raw["baro_altitude"]))
    kept = tuple(m for m in epoch.measurements if m.kind not in RAW_KINDS)
    clearance = _clearance(raw, epoch.attitude_deg)
    if clearance is not None and not any(m.kind == "terrain" for m in kept):
        altitude = _altitude(epoch, state)
        sigma = math.hypot(altitude.sigma, clearance.sigma)
        kept = (*kept, Measurement("terrain", altitude.value - clearance.value, sigma))
    if len(kept) == len(epoch.measurements) and not raw:
        return state, epoch
    return state, replace(epoch, measurements=kept)


def _clearance(raw: dict[str, Measurement], attitude_deg: tuple[float, float, float] | None) -> Measurement | None:
    """The vertical height above ground that this epoch measured, or None."""
    if "laser_altitude" not in raw:
        return raw.get("radar_altitude")
    slant = raw["laser_altitude"]
    if attitude_deg is None:
        return slant
    factor = float(slant_factor(attitude_deg[0], attitude_deg[1]))
    return replace(slant, value=slant.value * factor, sigma=slant.sigma * abs(factor))


def _altitude(epoch: Epoch, state: ReadyState) -> Measurement:
    """The altitude that goes with an altimeter reading."""
    if state.barometer is not None and 0.0 <= epoch.time_s - state.barometer[0].time_s <= state.max_age_s:
        then, reading = state.barometer
        return replace(reading, value=reading.value + (epoch.alt_m - then.alt_m))
    return Measurement("baro_altitude", epoch.alt_m, state.alt_sigma_m)
