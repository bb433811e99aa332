"""Units that the columns of foreign tables come in, as factors to the units of recording columns."""

from __future__ import annotations

import math

_LENGTH = {
    "m": 1.0,
    "km": 1000.0,
    "cm": 0.01,
    "mm": 0.001,
    "ft": 0.3048,
    "us_ft": 1200.0 / 3937.0,
    "fathom": 1.8288,
    "nmi": 1852.0,
}
_ANGLE = {
    "deg": 1.0,
    "rad": math.degrees(1.0),
    "arcmin": 1.0 / 60.0,
    "arcsec": 1.0 / 3600.0,
    "grad": 0.9,
}
_SPEED = {"m/s": 1.0, "cm/s": 0.01, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0, "ft/s": 0.3048, "ft/min": 0.3048 / 60.0}
_GRAVITY = {"mGal": 1.0, "uGal": 0.001, "Gal": 1000.0, "um/s2": 0.1, "m/s2": 1e5}
_MAGNETIC = {"nT": 1.0, "uT": 1000.0, "mG": 100.0, "G": 1e5, "T": 1e9}

#: time unit -> seconds
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0}

_BY_SUFFIX = {"m": _LENGTH, "deg": _ANGLE, "mps": _SPEED, "mgal": _GRAVITY, "nt": _MAGNETIC}


def units_of(column: str) -> dict[str, float]:
    """Units that a recording column can be given in -> factor to its own, which comes first."""
    return _BY_SUFFIX[column.rsplit("_", 1)[1]]
