"""Vertical datums: the surface that heights count from, and what lies between two of them.

A name is one of

- 'ellipsoid': the WGS-84 ellipsoid; ETRS89 and NAD83 ones count as it (within a metre or two);
- 'EGM96', 'EGM2008', 'EGM84': the geoids of these gravity models;
- 'mean sea level': by a tide gauge, a chart or a barometer set to one, without a geoid model;
- 'NAVD 88', or a vertical CRS that PROJ knows, by its name there ('DHHN2016', 'EVRF2007'): national levelling;
- 'MLLW', 'LAT' and the like: tide levels of charts;
- 'local': any zero, constant over the run; pressure altitude is one;
- None: unknown.

The first goes over into the next three by geoid heights N, h = H + N (`Geoid`). All that count from the sea differ by
a metre or two, and nothing here says by how much at a place; tide levels differ by the tide.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.checks import nearest_name
from terranav.core.errors import ConfigError, DataError, DataWarning, TerranavError
from terranav.core.memory import need
from terranav.maps.crs import projection
from terranav.maps.geoid import Geoid

if TYPE_CHECKING:
    from terranav.maps.map import Map

__all__ = [
    "Find",
    "Geoid",
    "Shift",
    "agreed_datum",
    "between",
    "convert",
    "shift_of",
    "split_crs",
    "stated_datum",
    "vertical_datum",
]

FloatArray = NDArray[np.float64]
Find = Callable[[str], Geoid | None]  #: gives the geoid of a datum, None where none is at hand

ELLIPSOID, SEA, LOCAL = "ellipsoid", "mean sea level", "local"
TIDES = ("MLLW", "MLW", "MHW", "MHHW", "LAT", "HAT", "LLWLT", "ISLW", "MLWS", "MHWS", "chart datum")
STAND_INS = ("EGM2008", "EGM96", "EGM84")  # what serves for a datum of the sea that has no grid of its own, best first

#: of 1,038,240 places, 15 arcmin apart, weighted by their area: EGM2008 (2.5 arcmin grid) less EGM96 (15 arcmin)
_EGMS = (
    "EGM96 and EGM2008 differ by 0.5 m (rms), by less than 1.1 m on 95 % of the Earth and by 12 m at most (Himalaya)"
)
_NOTHING = frozenset({"", "unknown", "not stated", "none", "n/a", "na", "unspecified", "undefined", "null"})
_CODES = {"5773": "EGM96", "3855": "EGM2008", "5798": "EGM84", "5714": SEA, "5715": SEA, "5703": "NAVD 88"}
_CODES |= {"4979": ELLIPSOID, "4937": ELLIPSOID}
_DTED = {"E84": "EGM84", "E96": "EGM96", "E08": "EGM2008", "WGS84": ELLIPSOID, "WGS 84": ELLIPSOID, "HAE": ELLIPSOID}
_TIDE_WORDS = {
    "mean lower low water": "MLLW",
    "mean low water": "MLW",
    "mean higher high water": "MHHW",
    "mean high water": "MHW",
    "lowest astronomical tide": "LAT",
    "highest astronomical tide": "HAT",
}
_PATTERNS = (
    (r"egm[\W_]*(?:20)?08", "EGM2008"),
    (r"egm[\W_]*(?:19)?96", "EGM96"),
    (r"egm[\W_]*(?:19)?84", "EGM84"),
    (r"navd[\W_]*(?:19)?88|north american vertical datum (?:of )?1988", "NAVD 88"),
    (r"ellips", ELLIPSOID),
    (r"\b[al]?msl\b|mean[\W_]+sea[\W_]+level|^sea[\W_]+level$", SEA),
    (r"^local\b|pressure altitude|^qfe$|^qne$", LOCAL),
)


def vertical_datum(text: str | None) -> str | None:
    """The name of a vertical datum in the words of files: codes, CRS names, WKT, compound CRSs, plain words.

    Parameters
    ----------
    text : str or None
        'EPSG:5773', 'EGM96 height', 'E96' (DTED), 'EPSG:4326+3855', WKT, 'WGS 84 ellipsoid', 'LMSL', 'MLLW', ...

    Returns
    -------
    str or None
        As at the head of this module; words that say nothing ('unknown') are None, other words come back as they are.
    """
    words = " ".join((text or "").split())
    if words.lower() in _NOTHING:
        return None
    if words.upper() in _DTED:
        return _DTED[words.upper()]
    code = re.fullmatch(r"(?:.*\bEPSG\W+(?:[\d.]+\W+)?|)(\d{4,5})", words, re.IGNORECASE)
    if code and code[1] in _CODES:
        return _CODES[code[1]]
    if code or re.match(r"[A-Z]+_?[A-Z0-9]*\[|\+|EPSG:\d+\+\d+$", words):
        return _of_crs(words)
    bare = re.sub(r"[\s_]+(?:height|depth)(?:\s*\(.*\))?$", "", words, flags=re.IGNORECASE)
    tide = next((name for name in TIDES if bare.lower() == name.lower()), None)
    for phrase, name in _TIDE_WORDS.items():
        tide = tide or (name if phrase in bare.lower() else None)
    if tide:
        return tide
    return next((name for pattern, name in _PATTERNS if re.search(pattern, words, re.IGNORECASE)), bare)


def stated_datum(text: str | None, where: str, error: type[TerranavError] = ConfigError) -> str | None:
    """`vertical_datum` of what a user states: words that neither terranav nor PROJ knows raise `error`.

    Parameters
    ----------
    text : str or None
    where : str
        What states it, for the message: 'flight.toml: [datum] alt_m'.
    error : type of exception
    """
    name = vertical_datum(text)
    if name is not None and _family(name) == "other":
        known = (ELLIPSOID, "EGM96", "EGM2008", "EGM84", SEA, "NAVD 88", *TIDES, LOCAL)
        near = nearest_name(name, known)
        raise error(f"{where} is {text!r}{near}, expected {', '.join(known)}, 'unknown', or a vertical CRS of PROJ")
    return name


def agreed_datum(named: Iterable[tuple[str, str | None]]) -> str | None:
    """The one vertical datum of several maps or tiles.

    Parameters
    ----------
    named : iterable of (name, datum)
        The datum in any words that `vertical_datum` takes.

    Returns
    -------
    str or None
        None where any of them is unknown, or nothing is given.

    Raises
    ------
    DataError
        Naming the first two that differ.
    """
    first, unknown = ("", ""), False
    for name, words in named:
        datum = vertical_datum(words)
        if datum is None:
            unknown = True
        elif not first[1]:
            first = name, datum
        elif datum != first[1]:
            raise DataError(
                f"{first[0]} counts heights from {first[1]}, but {name} from {datum}; "
                "expected one vertical datum (terranav.maps.datum.convert brings one to the other)"
            )
    return None if unknown else first[1] or None


def split_crs(crs: str) -> tuple[str, str | None]:
    """Horizontal CRS, and the name of the vertical datum of a compound or three-dimensional one; else None."""
    if crs in ("EPSG:4326", "EPSG:4269"):
        return crs, None
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        whole = CRS.from_user_input(crs)
    except CRSError:
        return crs, None
    if whole.is_compound:
        horizontal, vertical = whole.sub_crs_list[:2]
        name = str(vertical.name)
        grid = re.search(r"geoidgrids=(\S+)", crs) or re.search(r'(?:GRIDS|PARAMETERFILE)"?[^"]*"([^"]+)"', crs, re.I)
        known = name.lower() != "unknown"
        return str(horizontal.to_string()), name if known else vertical_datum(grid[1]) if grid else None
    if whole.is_geographic and len(whole.axis_info) == 3:
        return crs, ELLIPSOID
    return crs, None


def _of_crs(text: str) -> str | None:
    """The vertical datum of a CRS; the words themselves where PROJ does not know it."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        whole = CRS.from_user_input(f"EPSG:{text}" if text.isdecimal() else text)
    except CRSError:
        return text
    return (
        vertical_datum(whole.name)
        if whole.is_vertical and not whole.is_compound
        else vertical_datum(split_crs(text)[1])
    )


@lru_cache(maxsize=256)
def _family(name: str) -> str:
    """'ellipsoid', 'sea', 'tide', 'local', or 'other' for words that nobody knows."""
    if name in (ELLIPSOID, LOCAL):
        return name
    if name in (*STAND_INS, SEA, "NAVD 88"):
        return "sea"
    if name in TIDES:
        return "tide"
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    for words in (name, f"{name} height", f"{name} depth"):
        try:
            if CRS.from_user_input(words).is_vertical:
                return "sea"
        except CRSError:
            continue
    return "other"


@dataclass(frozen=True)
class Shift:
    """What is added to heights above one datum to count them from another.

    Attributes
    ----------
    source, target : str
    plus, minus : Geoid or None
        Their heights are added and subtracted; None is zero.
    doubt : str
        What the shift leaves out, in words with a figure; empty where nothing.
    bounded : bool
        False where what is left out may be any constant.
    """

    source: str
    target: str
    plus: Geoid | None = None
    minus: Geoid | None = None
    doubt: str = ""
    bounded: bool = True

    @property
    def geoids(self) -> tuple[Geoid, ...]:
        """The grids it uses."""
        return tuple(geoid for geoid in (self.plus, self.minus) if geoid is not None)

    def heights(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> FloatArray:
        """What to add at positions (shapes that broadcast, [deg]), of the broadcast shape [m].

        Raises
        ------
        DataError
            A grid says nothing at one of them.
        """
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, dtype=np.float64), np.asarray(lon_deg, dtype=np.float64))
        total = np.zeros(lat.shape)
        for sign, geoid in ((1.0, self.plus), (-1.0, self.minus)):
            if geoid is not None:
                height = geoid.height(lat, lon)
                bad = np.flatnonzero(np.isnan(height) & np.isfinite(lat) & np.isfinite(lon))
                if bad.size:
                    place = f"{lat.ravel()[bad[0]]:.4f} N, {lon.ravel()[bad[0]]:.4f} E"
                    raise DataError(f"{geoid.source}: no geoid height at {place}, expected a grid that covers it")
                total += sign * height
        return total


def between(source: str, target: str, find: Find) -> Shift:
    """What brings heights from one datum to another.

    Parameters
    ----------
    source, target : str
        Names that `vertical_datum` gives.
    find : function of a datum
        Gives its `Geoid`, or None.

    Raises
    ------
    DataError
        The ellipsoid on one side, and no geoid at hand: they differ by up to 107 m.
    """
    families = {_family(source), _family(target)}
    if source == target or families == {ELLIPSOID}:
        return Shift(source, target)
    if families & {LOCAL, "other"}:
        doubt = f"{source} and {target} differ by a constant that nothing here knows"
        return Shift(source, target, doubt=doubt, bounded=False)
    if ELLIPSOID not in families:
        plus, minus = find(source), find(target)
        if plus is not None and minus is not None:
            return Shift(source, target, plus, minus)
        return Shift(source, target, doubt=_difference(source, target))
    sea = target if source == ELLIPSOID else source
    geoid = next((found for found in map(find, dict.fromkeys((sea, *STAND_INS))) if found is not None), None)
    if geoid is None:
        raise DataError(
            f"heights above {source} and above {target} differ by the geoid height, up to 107 m, and no grid of it is "
            f"at hand; expected the geoid grid of {sea} (geoid=, --geoid FILE)"
        )
    doubt = "" if geoid.datum == sea else f"{_difference(sea, geoid.datum)}; the geoid of {geoid.datum} stands in"
    if source == ELLIPSOID:
        return Shift(source, target, minus=geoid, doubt=doubt)
    return Shift(source, target, plus=geoid, doubt=doubt)


def _difference(one: str, other: str) -> str:
    """How far two datums of the sea lie apart, where no grid says it."""
    if {one, other} == {"EGM96", "EGM2008"}:
        return _EGMS
    if "tide" in (_family(one), _family(other)):
        return f"{one} and {other} differ by the tide, up to several metres"
    return f"{one} and {other} differ by a metre or two"


def convert(chart: Map, to: str, find: Find | Geoid) -> Map:
    """A map of heights that counts from another datum: the same cells, each value shifted by geoid heights.

    Parameters, errors and warnings as of `shift_of`; DataError, too, where a geoid does not cover the map.

    Returns
    -------
    Map
        `datum` is the new one; sigma stays.
    """
    shift = shift_of(chart, to, find)
    from terranav.maps.map import Map  # a plain one, whatever the map is: its values are in memory now

    facts = {entry.name: getattr(chart, entry.name) for entry in fields(Map)}
    return Map(**{**facts, "values": _shifted(chart, shift), "datum": shift.target})


def shift_of(chart: Map, to: str, find: Find | Geoid) -> Shift:
    """What brings the heights of a map to another datum.

    Parameters
    ----------
    chart : Map
        Of kind 'terrain' or 'bathymetry', with a datum.
    to : str
        The datum it shall have, in the words of `vertical_datum`.
    find : function of a datum, or one Geoid
        What gives the geoids (`terranav.io.geoid.finder`).

    Raises
    ------
    ConfigError
        Unknown datum, or a map that has no heights.
    DataError
        The map's datum is unknown, no geoid is at hand, or nothing knows the difference.

    Warns
    -----
    DataWarning
        With the figure, where the shift leaves out something that is known to be small.
    """
    if chart.unit != "m":
        raise ConfigError(f"{chart.name}: a {chart.kind} map has no vertical datum, expected terrain or bathymetry")
    target, source = stated_datum(to, "datum"), vertical_datum(chart.datum)
    if target is None:
        raise ConfigError(f"datum is {to!r}, expected the vertical datum that the map shall have")
    if source is None:
        raise DataError(f"{chart.name}: the map's vertical datum is unknown, expected one (datum=, --map-datum)")
    try:
        shift = between(source, target, find if not isinstance(find, Geoid) else _only(find))
    except DataError as problem:
        raise DataError(f"{chart.name}: {problem}") from None
    if not shift.bounded or (shift.doubt and not shift.geoids):
        raise DataError(f"{chart.name}: cannot go from {source} to {target}: {shift.doubt}; expected a grid for each")
    if shift.doubt:
        warnings.warn(f"{chart.name}: {shift.doubt}", DataWarning, stacklevel=3)
    return shift


def _only(geoid: Geoid) -> Find:
    """What finds one geoid and no other."""
    return lambda datum: geoid if datum == geoid.datum else None


def _shifted(chart: Map, shift: Shift) -> NDArray[np.float32]:
    """The values of a map, each with the shift at the centre of its cell; some rows at a time."""
    (rows, cols), (a, b, c, d, e, f) = chart.shape, chart.transform
    need(8.0 * rows * cols, f"{chart.name}: map of {rows} x {cols} cells")
    out = np.array(chart.values, dtype=np.float32)
    step = max(2**20 // cols, 1)
    for first in range(0, rows, step):
        y, x = np.mgrid[first : min(first + step, rows), 0:cols] + 0.5
        lat, lon = projection(chart.crs).inverse(a * x + b * y + c, d * x + e * y + f)
        known = ~np.isnan(out[first : first + step])
        if shift.geoids and known.any():
            out[first : first + step][known] += shift.heights(np.asarray(lat)[known], np.asarray(lon)[known])
    out.setflags(write=False)
    return out
