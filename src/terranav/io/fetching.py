"""Map tiles from a server into a folder: whole, checked, resumed where they broke off, and asked for once only."""

from __future__ import annotations

import math
import string
import time
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError, DataError
from terranav.io.download import GoneError, Source, Trouble, digest, download, shown

Box = tuple[float, float, float, float]

MOST_TILES = 10_000  # in one call: more is a slip in the box, or a burden on the server
FIELDS = ("lat", "lon", "lat02", "lon03", "NS", "EW", "ns", "ew")
_PADDED = frozenset({"lat02", "lon03"})


@dataclass(frozen=True)
class Tile:
    """One square of the grid of tiles: its south-west corner [deg], where it lies, and what it is called here."""

    lat_deg: float
    lon_deg: float
    url: str
    name: str


@dataclass(frozen=True)
class Fetched:
    """What became of one tile.

    Attributes
    ----------
    tile : Tile
    state : str
        'fetched', 'resumed', 'replaced' (the file in the cache was damaged), 'cached' or 'missing' (no such tile).
    file : Path or None
        None where missing.
    size : int [bytes]
    sha256 : str
    """

    tile: Tile
    state: str
    file: Path | None = None
    size: int = 0
    sha256: str = ""


def tiles(template: str, box: Box, tile_deg: float = 1.0) -> list[Tile]:
    """The tiles that cover a box, from the south-west.

    Parameters
    ----------
    template : str
        http or https address with the fields of `FIELDS`: {lat}, {lon} the signed degrees of the south-west corner,
        {lat02}, {lon03} the same without sign and with zeros before, {NS}, {EW} (or {ns}, {ew}) the hemispheres.
    box : (south, west, north, east) [deg]
        East below west means a box across the antimeridian.
    tile_deg : float
        Side of a tile [deg]; goes into 180 a whole number of times.

    Raises
    ------
    ConfigError
        A field or an address that is none, a box without area or off the Earth, too many tiles.
    """
    side = finite("--tile-deg", tile_deg, above=0.0, maximum=90.0)
    if abs(180.0 / side - round(180.0 / side)) > 1e-9:
        raise ConfigError(f"--tile-deg is {tile_deg:g}, expected a size that goes into 180 a whole number of times")
    _check_template(template, whole=float(side).is_integer())
    south, west, north, east = (finite("--box", value) for value in box)
    width = (east - west) % 360.0 or 360.0 * (east != west)
    said = ",".join(f"{value:g}" for value in box)
    if not (-90.0 <= south < north <= 90.0 and width > 0.0):
        raise ConfigError(
            f"--box {said} has no area, expected S,W,N,E with south < north within 90 degrees, west < east"
        )
    slack = 1e-9
    rows = range(math.floor(south / side + slack), math.ceil(north / side - slack))
    cols = range(math.floor(west / side + slack), math.ceil((west + width) / side - slack))
    if len(rows) * len(cols) > MOST_TILES:
        raise ConfigError(f"--box {said} covers {len(rows) * len(cols)} tiles, expected at most {MOST_TILES}")
    corners = {(_tidy(row * side), _tidy((col * side + 180.0) % 360.0 - 180.0)): None for row in rows for col in cols}
    return [_tile(template, lat, lon) for lat, lon in corners]


def fetch_tiles(
    template: str,
    box: Box,
    cache: str | Path,
    *,
    tile_deg: float = 1.0,
    refresh: bool = False,
    attempts: int = 5,
    timeout_s: float = 30.0,
    pause: Callable[[float], None] = time.sleep,
) -> list[Fetched]:
    """Download the tiles that cover a box, unless the folder has them.

    Beside each file lies NAME.sha256, as `sha256sum -c` reads it, with the address in a comment; a file in the folder
    serves again while it has that checksum and is fetched again when not. What
    breaks off stays as NAME.part and is resumed where the server can. That a tile does not exist is kept in
    NAME.missing and believed until `refresh`.

    Parameters
    ----------
    template, box, tile_deg
        As of `tiles`.
    cache : str or Path
        Folder; made where it is not there.
    refresh : bool
        Ask again for tiles that did not exist.
    attempts : int
        For each tile, at least 1, with twice the pause after each.
    timeout_s : float
        Of silence on a connection [s].
    pause : function of seconds
        Waits between attempts.

    Returns
    -------
    list of Fetched

    Raises
    ------
    ConfigError
        As of `tiles`.
    DataError
        The folder cannot be written, is full or holds such a file from elsewhere; a server
        refuses or stays broken; or none of the tiles exists.
    """
    wanted = tiles(template, box, tile_deg)
    trouble = Trouble(int(finite("--attempts", attempts, minimum=1)), finite("--timeout", timeout_s, above=0.0), pause)
    folder = Path(cache)
    with _writable(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _writable(folder), _alone(folder):
        found = [_one(tile, folder, refresh, trouble) for tile in wanted]
    if all(one.state == "missing" for one in found):
        raise DataError(f"none of the {len(found)} tiles exists, such as {shown(found[0].tile.url)} (404)")
    return found


def _one(tile: Tile, folder: Path, refresh: bool, trouble: Trouble) -> Fetched:
    """One tile, from the folder or the server."""
    file, absent = folder / tile.name, folder / f"{tile.name}.missing"
    beside = folder / f"{tile.name}.sha256"
    source = Source(tile.url)
    damaged = False
    if file.exists():
        sha256 = digest(file)
        remark, stated = _read_record(beside)
        damaged = stated != sha256
        if remark != source.remark:
            raise DataError(f"{file}: was not fetched from {shown(tile.url)}, expected another --cache")
        if not damaged:
            return Fetched(tile, "cached", file, file.stat().st_size, sha256)
    elif not refresh and absent.exists() and absent.read_text(encoding="utf-8") == f"{source.remark}\n":
        return Fetched(tile, "missing")
    part = folder / f"{tile.name}.part"
    try:
        resumed = download(source, part, trouble)
    except GoneError:
        absent.write_text(f"{source.remark}\n", encoding="utf-8")
        file.unlink(missing_ok=True)  # a damaged one
        return Fetched(tile, "missing")
    sha256 = digest(part)
    aside = folder / f".{beside.name}.part"
    aside.write_text(_record(source, sha256, tile.name), encoding="utf-8")
    aside.replace(beside)  # before the file itself: killed in between, the file is fetched again
    part.replace(file)
    absent.unlink(missing_ok=True)
    state = "replaced" if damaged else "resumed" if resumed else "fetched"
    return Fetched(tile, state, file, file.stat().st_size, sha256)


def _record(source: Source, sha256: str, name: str) -> str:
    """The text of NAME.sha256."""
    return f"{source.remark}\n{sha256}  {name}\n"


def _read_record(beside: Path) -> tuple[str, str]:
    """The address and the checksum in NAME.sha256, empty where they are not there."""
    try:
        remark, line = beside.read_text(encoding="utf-8").splitlines()[:2]
    except (FileNotFoundError, ValueError):
        return "", ""
    return remark, line.partition(" ")[0]


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    """What the disk refuses is a DataError that names the folder."""
    try:
        yield
    except OSError as problem:
        raise DataError(
            f"{folder}: the cache cannot be written ({problem.strerror or problem}), expected a folder with space"
        ) from None


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two that write the same part would spoil it: DataError where another process is at work here."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with (folder / ".lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DataError(f"{folder}: another fetch is at work in this cache, expected that to end first") from None
        yield


def _check_template(template: str, *, whole: bool) -> None:
    """ConfigError unless the template is an address in which every tile is another one."""
    try:
        fields = [part[1:] for part in string.Formatter().parse(template) if part[1] is not None]
    except ValueError as problem:
        raise ConfigError(f"--template {template!r}: {problem}, expected fields such as {{lat02}}") from None
    for name, form, conversion in fields:
        if name not in FIELDS:
            unknown_name("field in --template", str(name), FIELDS)
        if form or conversion:
            raise ConfigError(f"--template: field {{{name}}} carries a format, expected one of {', '.join(FIELDS)}")
        if name in _PADDED and not whole:
            raise ConfigError(f"--template: field {{{name}}} needs whole degrees, expected {{lat}} and {{lon}}")
    names = {name for name, _, _ in fields}
    if not (names & {"lat", "lat02"} and names & {"lon", "lon03"}):
        raise ConfigError(
            "--template has no field for the latitude or the longitude, expected both, such as {lat} {lon}"
        )
    if urllib.parse.urlsplit(template).scheme not in ("http", "https") or "//" not in template:
        raise ConfigError(f"--template {template!r}: expected an address that begins with http:// or https://")


def _tile(template: str, lat: float, lon: float) -> Tile:
    """The tile with this south-west corner."""
    values: dict[str, Any] = {
        "lat": f"{lat:g}",
        "lon": f"{lon:g}",
        "lat02": f"{abs(lat):02.0f}",
        "lon03": f"{abs(lon):03.0f}",
        "NS": "S" if lat < 0 else "N",
        "EW": "W" if lon < 0 else "E",
    }
    values |= {"ns": values["NS"].lower(), "ew": values["EW"].lower()}
    last = urllib.parse.urlsplit(template).path.rsplit("/", 1)[-1]
    name = urllib.parse.unquote(last.format(**values)).replace("/", "_").replace("\\", "_").strip(". ")
    inside = {part[1] for part in string.Formatter().parse(last)}
    if not (inside & {"lat", "lat02"} and inside & {"lon", "lon03"}):  # the folders of the address make the difference
        corner = f"{values['NS']}{abs(lat):g}{values['EW']}{abs(lon):g}"
        name = f"{corner}-{name}" if name else corner
    if not name.isprintable():
        raise ConfigError(f"--template {template!r}: makes the file name {name!r}, expected printable characters")
    return Tile(lat, lon, template.format(**values), name)


def _tidy(degrees: float) -> float:
    """Without the dust of multiplication; zero has no sign."""
    return round(degrees, 9) + 0.0
