"""Where the map ends ahead: the corrected position carried on with the velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terranav.core.earth import shift
from terranav.maps.map import Map

MOST_POINTS = 64


def map_ends_s(
    charts: Sequence[Map], place: tuple[float, float], velocity_mps: tuple[float, float], within_s: float
) -> float:
    """When the first of the maps that say something here says nothing any more.

    Parameters
    ----------
    charts : sequence of Map
        Those that say nothing at the place itself are not looked at while another does.
    place : (lat, lon) [deg]
    velocity_mps : (north, east) [m/s]
    within_s : float
        How far ahead to look [s].

    Returns
    -------
    float
        [s], infinite where every map goes on, 0 where none says anything at the place itself.
    """
    length = math.hypot(*velocity_mps) * within_s
    ends, here = math.inf, False
    for chart in charts:
        count = min(max(int(length / chart.cell_m) + 1, 2), MOST_POINTS)
        ahead_s = np.linspace(0.0, within_s, count)
        lat, lon = shift(*place, velocity_mps[0] * ahead_s, velocity_mps[1] * ahead_s)
        void = np.isnan(chart.sample(lat, lon))
        here = here or not void[0]
        if not void[0] and void.any():
            ends = min(ends, float(ahead_s[np.argmax(void)]))
    return ends if here else 0.0
