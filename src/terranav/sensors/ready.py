"""Raw readings turned into what compares with a map: terrain height = altitude - clearance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

from terranav.core.checks import finite
from terranav.core.recording import DEFAULT_RAW_SIGMA_M
from terranav.core.records import Epoch, Measurement
from terranav.sensors.altimeter import slant_factor

RAW_KINDS = ("radar_altitude", "laser_altitude", "baro_altitude")


def ready(
    epochs: Iterable[Epoch],
    *,
    max_age_s: float = 2.0,
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
    finite("ready max_age_s", max_age_s, minimum=0.0)
    finite("ready alt_sigma_m", alt_sigma_m, above=0.0)
    baro: tuple[Epoch, Measurement] | None = None
    for epoch in epochs:
        raw = {m.kind: m for m in epoch.measurements if m.kind in RAW_KINDS and math.isfinite(m.value)}
        if "baro_altitude" in raw:
            baro = epoch, raw["baro_altitude"]
        kept = tuple(m for m in epoch.measurements if m.kind not in RAW_KINDS)
        clearance = _clearance(raw, epoch.attitude_deg)
        if clearance is not None and not any(m.kind == "terrain" for m in kept):
            altitude = _altitude(epoch, baro, max_age_s, alt_sigma_m)
            sigma = math.hypot(altitude.sigma, clearance.sigma)
            kept = (*kept, Measurement("terrain", altitude.value - clearance.value, sigma))
        yield epoch if len(kept) == len(epoch.measurements) and not raw else replace(epoch, measurements=kept)


def _clearance(raw: dict[str, Measurement], attitude_deg: tuple[float, float, float] | None) -> Measurement | None:
    """The vertical height above ground that this epoch measured, or None."""
    if "laser_altitude" not in raw:
        return raw.get("radar_altitude")
    slant = raw["laser_altitude"]
    if attitude_deg is None:
        return slant
    factor = float(slant_factor(attitude_deg[0], attitude_deg[1]))
    return replace(slant, value=slant.value * factor, sigma=slant.sigma * abs(factor))


def _altitude(
    epoch: Epoch, baro: tuple[Epoch, Measurement] | None, max_age_s: float, alt_sigma_m: float
) -> Measurement:
    """The altitude that goes with an altimeter reading."""
    if baro is not None and 0.0 <= epoch.time_s - baro[0].time_s <= max_age_s:
        then, reading = baro
        return replace(reading, value=reading.value + (epoch.alt_m - then.alt_m))
    return Measurement("baro_altitude", epoch.alt_m, alt_sigma_m)
