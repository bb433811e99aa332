"""Radar and laser altimeters: the height above the ground, with its errors.

A laser has a narrow beam fixed to the body: what it reads is the slant range, the vertical clearance over
cos(roll) cos(pitch) above flat ground. A radar altimeter's wide beam returns the nearest ground first, so over the
usual bank angles its reading is the vertical clearance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.checks import unknown_name
from terranav.sensors.bands import Band, HeightSensor

FloatArray = NDArray[np.float64]
KINDS_OF_ALTIMETER = ("radar", "laser")


@dataclass(frozen=True)
class Altimeter(HeightSensor):
    """Error model of a radar or laser altimeter; the further attributes are those of `HeightSensor`.

    Attributes
    ----------
    kind : str
        'radar' or 'laser'; its readings are the recording column radar_altitude_m or laser_altitude_m.
    min_m : float
        Shortest range [m].
    """

    min_m: float = 0.0
    kind: str = "radar"

    label: ClassVar[str] = "altimeter"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        # papers/003, Table 1, radar altitude error: taken for 1-sigma, which the paper does not say
        "paper_003": {
            "kind": "radar",
            "bands": (
                Band(30.0, sigma_fraction=0.001),
                Band(150.0, sigma_fraction=0.003),
                Band(2000.0, sigma_fraction=0.004),
            ),
        }
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in KINDS_OF_ALTIMETER:
            unknown_name("altimeter kind", str(self.kind), KINDS_OF_ALTIMETER)

    @property
    def column(self) -> str:
        """The recording column of its readings."""
        return f"{self.kind}_altitude_m"


def slant_factor(roll_deg: ArrayLike, pitch_deg: ArrayLike) -> FloatArray:
    """Vertical clearance over slant range of a beam along the body's down axis, above flat ground.

    Parameters
    ----------
    roll_deg, pitch_deg : array_like, shapes that broadcast [deg]

    Returns
    -------
    ndarray [1]
        cos(roll) cos(pitch): the down component of the body's down axis.
    """
    roll, pitch = np.radians(np.asarray(roll_deg, np.float64)), np.radians(np.asarray(pitch_deg, np.float64))
    return np.asarray(np.cos(roll) * np.cos(pitch))
