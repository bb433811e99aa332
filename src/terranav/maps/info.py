"""What a map is and what looks wrong with it, for people and machines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.kinds import kind_named

if TYPE_CHECKING:
    from terranav.maps.map import Map

LEAST_CELL_M = 0.02  # below this the coordinates are degrees that are called metres
MANY_ZEROS = 0.3  # share of the values


def describe(m: Map) -> dict[str, Any]:
    """The dictionary of `Map.info`.

    `roughness` is the root mean square difference of neighbouring cells [unit], the sigma_z of the TERCOM literature
    (Golden, SPIE 238, 1980); `std` its sigma_T.
    """
    values = m.values[~np.isnan(m.values)].astype(np.float64)
    south, west, north, east = m.bounds_deg
    steps = np.concatenate([np.diff(m.values, axis=axis).ravel() for axis in (0, 1)]).astype(np.float64)
    steps = steps[~np.isnan(steps)]
    void_fraction = 1.0 - values.size / m.values.size
    void_remark = [f"{100.0 * void_fraction:.0f} % of the cells are void"] if void_fraction > 0.25 else []
    std = float(values.std())
    return {
        "name": m.name,
        "kind": m.kind,
        "unit": m.unit,
        "rows": m.shape[0],
        "cols": m.shape[1],
        "cell_m": m.cell_m,
        "extent_deg": {"south": south, "west": west, "north": north, "east": east},
        "crs": m.crs,
        "datum": m.datum,
        "sigma": m.sigma,
        "voids": int(m.values.size - values.size),
        "void_fraction": void_fraction,
        "min": float(values.min()),
        "max": float(values.max()),
        "mean": float(values.mean()),
        "std": std,
        "roughness": float(np.sqrt(np.mean(steps**2))) if steps.size else float("nan"),
        "source": m.source,
        "checksum": m.checksum,
        "suspicious": suspicions(m.values, m.kind) + void_remark + _of_values(m, values, std) + _of_place(m),
    }


def _of_values(m: Map, values: NDArray[np.float64], std: float) -> list[str]:
    """What cannot be a terrain of its own."""
    found = []
    zero = float(np.mean(values == 0.0))
    if zero > MANY_ZEROS and values.min() != values.max():
        found.append(f"{100.0 * zero:.0f} % of the values are exactly 0 {m.unit}: sea, or voids that are not marked?")
    if 0.0 < std < m.sigma:
        found.append(
            f"the values vary by {std:.2g} {m.unit} only, less than the map's sigma: they tell little of a place"
        )
    return found


def _of_place(m: Map) -> list[str]:
    """What says that the coordinates are not those of the CRS."""
    south, west, north, east = m.bounds_deg
    found = []
    if south < -90.5 or north > 90.5 or east - west > 360.5:
        found.append(
            f"latitudes from {south:g} to {north:g} and longitudes from {west:g} to {east:g} in {m.crs}: "
            "are the coordinates metres of another CRS?"
        )
    elif m.cell_m < LEAST_CELL_M:
        found.append(f"cells of {1000.0 * m.cell_m:.2g} mm in {m.crs}: are the coordinates degrees (EPSG:4326)?")
    return found


def suspicions(values: NDArray[np.float32], kind_name: str) -> list[str]:
    """One line for everything about the values of a map of this kind that says they may not be what they are called."""
    kind = kind_named(kind_name)
    low, high, middle = float(np.nanmin(values)), float(np.nanmax(values)), float(np.nanmedian(values))
    least, most = kind.plausible
    found = []
    if low < least or high > most:
        hint = "; are they in feet?" if kind.unit == "m" else ""
        found.append(
            f"values run from {low:g} to {high:g} {kind.unit}, "
            f"but {kind.name} on Earth stays within {least:g} to {most:g} {kind.unit}{hint}"
        )
    if kind.name == "bathymetry" and middle > 0.0:
        found.append(
            f"the median is {middle:g} m, but the seabed is negative below the datum; are these positive depths?"
        )
    if low == high:
        found.append(f"every value is {low:g} {kind.unit}: a constant map cannot tell where anything is")
    return found
