"""Mosaics from files: which files of a folder or pattern are tiles, and whether they go together."""

from __future__ import annotations

import glob
import hashlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError, DataWarning
from terranav.io.files import existing_file
from terranav.io.sources import WHAT, How, Source, source_of
from terranav.maps.datum import agreed_datum, vertical_datum
from terranav.maps.info import suspicions
from terranav.maps.mosaic import MEMORY_MB, Mosaic
from terranav.maps.tiles import Layer, Tile, interpolated

#: suffixes of files that are taken for tiles when a folder is opened
TILES = (
    ".hgt", ".hgt.zip", ".hgt.gz", ".tif", ".tiff", ".tif.gz", ".dt0", ".dt1", ".dt2", ".nc", ".grd", ".asc", ".img",
    ".bil", ".flt", ".bag",
)  # fmt: skip
FINGER_BYTES = 2**16  # of either end of a file that go into the checksum of a mosaic
MOST_PAIRS = 200  # pairs of overlapping tiles that are compared
LOOKED_AT = 64  # cells: side of the part of an overlap, or of a tile, that is looked at
MOST_NAMED = 5  # lines of a kind before 'and so many more'
DISAGREE = 3.0  # sigmas of the map

Paths = str | Path | Sequence[str | Path]


def paths_of(path: Paths) -> list[Path] | None:
    """The files of a folder, a pattern or a list, sorted but for the list; None for a single file.

    Raises
    ------
    DataError
        There is none.
    """
    if not isinstance(path, (str, Path)):
        found = [existing_file(each, WHAT) for each in path]
        if not found:
            raise DataError("the list of map files is empty, expected at least one")
        return found
    text = str(path)
    if Path(text).is_dir():
        found = [file for file in Path(text).rglob("*") if _is_tile(file)]
        expected = f"files such as {', '.join(TILES[:5])}"
    elif glob.has_magic(text) and not Path(text).exists():
        found = [Path(file) for file in glob.iglob(text, recursive=True) if Path(file).is_file()]
        expected = "files that match it"
    else:
        return None
    if not found:
        raise DataError(f"{text}: no map in it, expected {expected}")
    return sorted(found)


def mosaic_of(path: Paths, how: How, about: Mapping[str, Any], memory_mb: float = MEMORY_MB) -> Mosaic:
    """The mosaic of tiles, or of one large file.

    A tile that cannot be opened is named in a DataWarning and left out, as is one that cannot be read later. Tiles that
    disagree where they overlap are a DataWarning with figures.

    Parameters
    ----------
    path : as of `open_map`
    how : How
    about : mapping
        kind, sigma, correlation_m, datum, name, as of `Map`; the datum None is what the tiles state.
    memory_mb : float

    Raises
    ------
    DataError
        No tile can be opened, or two have different vertical datums.
    """
    files = paths_of(path) or [Path(str(path))]
    opened, failed = _opened(files, how)
    if not opened:
        raise DataError(
            failed[0] if len(files) == 1 else f"{path}: none of its {len(files)} files is a map ({failed[0]})"
        )
    _warn(failed, "left out")
    for source in opened:
        _warn(source.doubts)
    label = str(about.get("name") or _name_of(path, files))
    datum = about.get("datum") or _datum(label, opened)
    tiles = [_tile(source) for source in opened]
    sigma = float(about["sigma"])
    _warn(_suspicious(label, tiles, how.kind))
    _warn(list(_disagreements(tiles, sigma)))
    given = {**about, "name": label, "source": label, "datum": datum}
    again = partial(mosaic_of, path, how, about, memory_mb)
    return Mosaic(tiles, given, memory_mb, again, finest_first=isinstance(path, (str, Path)))


def _is_tile(file: Path) -> bool:
    """Whether a file of a folder is taken for a tile."""
    return file.name.lower().endswith(TILES) and not file.name.startswith(".") and file.is_file()


def _name_of(path: Paths, files: Sequence[Path]) -> str:
    if isinstance(path, (str, Path)):
        return Path(str(path)).name
    return f"{files[0].name} and {len(files) - 1} more" if len(files) > 1 else files[0].name


def _opened(files: Sequence[Path], how: How) -> tuple[list[Source], list[str]]:
    """What can be opened, and what is wrong with the rest."""
    opened, failed = [], []
    for file in files:
        try:
            opened.append(source_of(file, how))
        except DataError as error:
            failed.append(str(error))
    return opened, failed


def _datum(label: str, sources: Sequence[Source]) -> str | None:
    """The one vertical datum of tiles; None, and a warning, where only some state theirs."""
    datum = agreed_datum((str(source.file), source.grid.datum) for source in sources)
    silent = [source for source in sources if vertical_datum(source.grid.datum) is None]
    if datum is None and len(silent) < len(sources):
        stated = next(source.grid.datum for source in sources if vertical_datum(source.grid.datum) is not None)
        text = (
            f"{len(silent)} of {len(sources)} tiles, such as {silent[0].file}, name no vertical datum, others {stated}"
        )
        _warn([f"{label}: {text}; taken as unknown, datum= (--map-datum) says it"])
    return datum


def _tile(source: Source) -> Tile:
    return Tile(str(source.file), source.place, source.read_again, partial(_fingerprint, source.file))


def _fingerprint(file: Path) -> str:
    """Name and size of a file, and a checksum of its two ends."""
    size = file.stat().st_size
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        digest.update(stream.read(FINGER_BYTES))
        stream.seek(max(size - FINGER_BYTES, 0))
        digest.update(stream.read(FINGER_BYTES))
    return f"{file.name} {size} {digest.hexdigest()}"


def _suspicious(label: str, tiles: Sequence[Tile], kind: str) -> list[str]:
    """What looks wrong with the values in the middle of some tiles."""
    parts = []
    for tile in tiles[:: -(-len(tiles) // 9)]:
        middle = [max((size - LOOKED_AT) // 2, 0) for size in tile.place.shape]
        window = [(low, min(low + LOOKED_AT, size)) for low, size in zip(middle, tile.place.shape, strict=True)]
        try:
            parts.append(tile.read((window[0], window[1])).ravel())
        except DataError:
            continue  # named when it is needed
    values = np.concatenate(parts) if parts else np.empty(0, np.float32)
    if not np.isfinite(values).any():
        return []
    return [f"{label}: {text}" for text in suspicions(values, kind) if "constant" not in text]


def _disagreements(tiles: Sequence[Tile], sigma: float) -> Iterator[str]:
    """One line for each pair of tiles that differ where they overlap by more than the map's error allows."""
    pairs = _overlapping(tiles)
    for i, j in pairs[:: max(-(-len(pairs) // MOST_PAIRS), 1)]:
        try:
            difference = _difference(tiles[i], tiles[j])
        except DataError:
            continue  # named when it is needed
        if difference.size < 2:
            continue
        rms = float(np.sqrt(np.mean(difference**2)))
        if rms > DISAGREE * sigma:
            mean = float(difference.mean())
            yield (
                f"{tiles[i].name} and {tiles[j].name} differ by {rms:.1f} rms ({mean:+.1f} on average) "
                f"over {difference.size} cells in which they overlap, where the map's error is {sigma:g}"
            )


def _overlapping(tiles: Sequence[Tile]) -> list[tuple[int, int]]:
    """Pairs of tiles whose boxes overlap."""
    bounds = np.array([tile.place.bounds_deg for tile in tiles])
    south, west, north, east = bounds.T
    found = []
    for i in range(len(tiles) - 1):
        apart = (west[i + 1 :] - west[i] + 180.0) % 360.0 - 180.0
        across = (apart < east[i] - west[i]) & (apart + east[i + 1 :] - west[i + 1 :] > 0.0)
        along = (south[i + 1 :] < north[i]) & (north[i + 1 :] > south[i])
        found += [(i, i + 1 + int(k)) for k in np.flatnonzero(across & along)]
    return found


def _difference(one: Tile, other: Tile) -> NDArray[np.float64]:
    """First less second at cells of the first in the middle of what both cover."""
    rows, cols = one.place.shape
    s, w, n, e = other.place.bounds_deg
    t = np.linspace(0.0, 1.0, 9)
    row, col = one.place.cells(s + t[:, None] * (n - s), w + t[None, :] * (e - w))
    known = np.isfinite(row) & np.isfinite(col)
    if not known.any():
        return np.empty(0)
    window = (_middle(row[known], rows), _middle(col[known], cols))
    mine = one.read(window).astype(np.float64)
    theirs = np.full(mine.shape, np.nan, np.float32)
    interpolated(Layer([other]), one.place, (window[0][0], window[1][0]), theirs)
    difference = mine - theirs
    return difference[np.isfinite(difference)]


def _middle(position: NDArray[np.float64], size: int) -> tuple[int, int]:
    """The middle LOOKED_AT cells of a span within a map."""
    low, high = max(float(position.min()), 0.0), min(float(position.max()), size - 1.0)
    half = min(0.5 * (high - low), 0.5 * LOOKED_AT)
    middle = 0.5 * (low + high)
    first = min(max(int(np.ceil(middle - half - 1e-6)), 0), size - 1)
    return first, min(max(int(np.floor(middle + half + 1e-6)) + 1, first + 1), size)


def _warn(lines: Sequence[str], then: str = "") -> None:
    """A DataWarning a line, the first few."""
    for line in lines[:MOST_NAMED]:
        warnings.warn(f"{line}; {then}" if then else line, DataWarning, stacklevel=4)
    if len(lines) > MOST_NAMED:
        rest = ", ".join(line.split(":")[0] for line in lines[MOST_NAMED:])
        warnings.warn(f"and {len(lines) - MOST_NAMED} more like this: {rest[:2000]}", DataWarning, stacklevel=4)
