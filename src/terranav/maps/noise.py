"""How far a reading may lie from the map: the sensor's noise and the map's error together."""

from __future__ import annotations

import math

from terranav.core.earth import offset_of
from terranav.core.records import Epoch, Measurement
from terranav.maps.map import Map

MOST_REPEATED = 1000.0  # readings that share one map cell and are still told apart


def reading_sigma(reading: Measurement, chart: Map, previous: Epoch | None, epoch: Epoch) -> float:
    """1-sigma of reading minus map [the kind's unit], with readings of one map cell sharing that cell's error.

    The error of a map is taken as constant over a cell. A vehicle that takes k readings within one cell averages the
    sensor's noise, but not the map's error; weighing each reading with k sigma_map^2 gives the k together the weight of
    one.

    Parameters
    ----------
    reading : Measurement
    chart : Map of its kind
    previous : Epoch or None
        The epoch of the last reading before this one, None for the first.
    epoch : Epoch
        The epoch of this reading.
    """
    shared = 1.0
    if previous is not None:
        spacing = math.hypot(*offset_of(previous.lat_deg, previous.lon_deg, epoch.lat_deg, epoch.lon_deg))
        shared = min(max(1.0, chart.cell_m / max(spacing, 1e-9)), MOST_REPEATED)
    return math.sqrt(reading.sigma**2 + chart.sigma**2 * shared)
