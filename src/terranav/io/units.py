"""Units that files state their values in, and what turns them into the one unit of a map kind."""

from __future__ import annotations

from terranav.core.checks import unknown_name
from terranav.core.errors import DataError
from terranav.core.kinds import Kind

_LENGTHS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048),
    **dict.fromkeys(("us-ft", "ussft", "ftus", "us survey foot", "us survey feet", "foot_us"), 1200.0 / 3937.0),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
    **dict.fromkeys(("dm", "decimetre", "decimetres", "decimeter", "decimeters"), 0.1),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("fathom", "fathoms", "ftm"), 1.8288),
}
_GRAVITY = {
    **dict.fromkeys(("mgal", "milligal", "milligals"), 1.0),
    **dict.fromkeys(("gal", "gals"), 1e3),
    **dict.fromkeys(("ugal", "µgal", "microgal", "microgals"), 1e-3),
    **dict.fromkeys(("m/s2", "m/s^2", "m/s**2", "m s-2", "m s^-2"), 1e5),
    **dict.fromkeys(("um/s2", "um/s^2", "gu", "g.u."), 0.1),
}
_MAGNETIC = {
    **dict.fromkeys(("nt", "nanotesla", "nanoteslas", "gamma", "gammas"), 1.0),
    **dict.fromkeys(("ut", "µt", "microtesla", "microteslas"), 1e3),
    **dict.fromkeys(("t", "tesla"), 1e9),
    **dict.fromkeys(("gauss",), 1e5),
}
_FACTORS = {"m": _LENGTHS, "mGal": _GRAVITY, "nT": _MAGNETIC}
_SAYS_NOTHING = frozenset({"", "1", "unknown", "none", "user_z_unit", "z"})


def unit_factor(file: str, kind: Kind, stated: str, declared: str | None, doubts: list[str]) -> float:
    """What the values of a file are multiplied by to be in the unit of their kind.

    Parameters
    ----------
    file : str
        Its name, for messages.
    kind : Kind
    stated : str
        The unit in the file, empty where it states none.
    declared : str or None
        The unit that the user gave; it wins.
    doubts : list of str
        Gains a line where the file contradicts the user, or states a unit that is not known.

    Raises
    ------
    ConfigError
        The declared unit is unknown for this kind.
    DataError
        The stated unit is one of another kind of field.
    """
    factors = _FACTORS[kind.unit]
    said = stated.strip().lower()
    if declared is not None:
        factor = factors.get(declared.strip().lower())
        if factor is None:
            unknown_name(f"unit of a {kind.name} map", declared, factors)
        if said in factors and factors[said] != factor:
            doubts.append(f"{file}: the file says that its unit is {stated!r}, taken as {declared!r} as declared")
        return factor
    if said in factors:
        return factors[said]
    if any(said in others for others in _FACTORS.values()):
        raise DataError(
            f"{file}: the unit is {stated!r}, expected one of a {kind.name} map such as {kind.unit!r}; "
            "is it of another kind or variable?"
        )
    if said not in _SAYS_NOTHING:
        doubts.append(f"{file}: the unit {stated!r} is not known, taken as {kind.unit!r}; say unit= to be sure")
    return 1.0
