"""The kinds of field that can be measured and mapped. A new kind is a row here, not a class."""

from __future__ import annotations

from dataclasses import dataclass

from terranav.core.checks import unknown_name


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of mapped field.

    Attributes
    ----------
    name : str
        'terrain', 'bathymetry', 'gravity' or 'magnetic'.
    unit : str
        The one unit of values, sigmas and map errors of this kind.
    column : str
        The recording column that holds ready measurements of this kind.
    sigma_column : str
        The optional recording column with the 1-sigma of each of them.
    sign : int
        Map value = sign * column value: depths are positive down, maps of the seabed negative below the datum.
    plausible : tuple of float
        Smallest and largest map value that occurs on Earth [unit]; outside it the unit is suspect.
    default_sigma : float
        1-sigma [unit] assumed, with a warning, when a recording states none.
    bias_sigma : float
        1-sigma of an error common to all readings of a run that estimators with a bias state allow for [unit]:
        barometer and vertical datum (m), tide, draught and sound speed (m), the reference of a gravity survey (mGal),
        main field and vehicle (nT).
    bias_walk : float
        Random walk of that error [unit/sqrt(s)]: weather, tide, drift of the gravimeter, daily variation.
    """

    name: str
    unit: str
    column: str
    sigma_column: str
    sign: int
    plausible: tuple[float, float]
    default_sigma: float
    bias_sigma: float
    bias_walk: float


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("terrain", "m", "terrain_m", "terrain_sigma_m", 1, (-450.0, 8900.0), 5.0, 15.0, 0.05),
        Kind("bathymetry", "m", "depth_m", "depth_sigma_m", -1, (-11100.0, 8900.0), 10.0, 5.0, 0.05),
        Kind("gravity", "mGal", "gravity_mgal", "gravity_sigma_mgal", 1, (-1000.0, 1000.0), 2.0, 20.0, 0.02),
        Kind("magnetic", "nT", "magnetic_nt", "magnetic_sigma_nt", 1, (-70000.0, 70000.0), 20.0, 50.0, 0.3),
    )
}


def kind_named(name: str) -> Kind:
    """Return the Kind of this name; raise ConfigError, offering the nearest name, when there is none."""
    if name not in KINDS:
        unknown_name("map kind", name, KINDS)
    return KINDS[name]
