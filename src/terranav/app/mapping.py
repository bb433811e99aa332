"""What `terranav map` does between its options and the modules that do the work."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terranav.app.given import embedded
from terranav.app.listing import map_pairs
from terranav.app.words import coordinate, percent
from terranav.core.checks import finite
from terranav.core.earth import wrap_longitude
from terranav.core.errors import ConfigError

if TYPE_CHECKING:
    from terranav.io.fetching import Fetched
    from terranav.io.thinning import Part
    from terranav.maps.geoid import Geoid

Box = tuple[float, float, float, float]


def parsed_box(text: str | None) -> Box | None:
    """South, west, north, east of '47,9,48,10' [deg]; None for None, ConfigError for other texts."""
    return None if text is None else required_box(text)


def required_box(text: str) -> Box:
    """South, west, north, east of '47,9,48,10' [deg]; ConfigError for other texts."""
    expected = ConfigError(f"--box is {text!r}, expected S,W,N,E in degrees, such as 47,9,48,10")
    try:
        south, west, north, east = (finite("--box", float(part)) for part in text.split(","))
    except ValueError:  # ConfigError is one
        raise expected from None
    if not -90.0 <= south < north <= 90.0:
        raise ConfigError(f"--box is {text!r} and has no area on Earth, expected S,W,N,E with -90 <= S < N <= 90")
    if west == east:
        raise ConfigError(f"--box is {text!r} and has no area, expected S,W,N,E with west and east apart")
    return south, west, north, east


def opened(file: Path, box: str | None = None, **options: Any) -> Part:
    """A map, or what lies in a box of it; 'sample' is the embedded one.

    Parameters
    ----------
    file : Path
    box : str, optional
        As typed.
    **options
        Of `terranav.io.rasters.open_map`.
    """
    from terranav.io.thinning import open_part, part_of

    where, chart = parsed_box(box), embedded(file, options)
    if chart is None:
        return open_part(file, where, **options)
    return part_of(chart if where is None else chart.crop(*where))


def geoids_from(texts: Sequence[str]) -> list[Geoid]:
    """Geoid grids from what was typed: FILE, or DATUM=FILE where neither the file nor its name says what it is for."""
    from terranav.io.geoid import open_geoid

    found = []
    for text in texts:
        datum, equals, file = text.partition("=")
        named = bool(equals) and not Path(text).exists()
        found.append(open_geoid(file, datum=datum) if named else open_geoid(text))
    return found


def map_words(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """`Map.info` in words, with longitudes from -180 to 180, and that nothing is suspicious where nothing is."""
    words = dict(map_pairs({**facts, "suspicious": []}))
    words["extent"] = _extent(facts["extent_deg"])
    size = 5 if facts["std"] >= 1000.0 else 3
    unit = facts["unit"]
    words["roughness"] = f"{facts['roughness']:.3g} {unit} from cell to cell, {facts['std']:.{size}g} {unit} in all"
    if facts["voids"]:
        words["voids"] = f"{facts['voids']} cells ({percent(facts['void_fraction'], 1)}) without a value"
    else:
        words["voids"] = "none"
    if facts.get("looked_at", 1.0) < 1.0:
        words["looked at"] = f"{percent(facts['looked_at'], 1)} of the cells, spread over the tiles"
    doubts = facts["suspicious"] or ["nothing"]
    return [*words.items(), *[("suspicious", text) for text in doubts]]


def meridian(lon_deg: float, digits: int) -> str:
    """A longitude with its hemisphere, whichever turn it is on: 180.25 is 179.75° W; none at 0 and 180."""
    lon = round(float(wrap_longitude(lon_deg)), digits)
    return f"{abs(lon):.{digits}f}°" if lon in (0.0, 180.0, -180.0) else coordinate(lon, "E", "W", digits)


def parallel(lat_deg: float, digits: int) -> str:
    """A latitude with its hemisphere, none at the equator."""
    lat = round(lat_deg, digits)
    return f"{0.0:.{digits}f}°" if lat == 0.0 else coordinate(lat, "N", "S", digits)


def _extent(box: Mapping[str, float]) -> str:
    """A box in words."""
    if box["east"] - box["west"] >= 360.0 - 1e-9:
        south, north = (parallel(box[side], 4) for side in ("south", "north"))
        return f"{south} to {north}, all longitudes"
    west, east = (meridian(box[side], 4) for side in ("west", "east"))
    south, north = (parallel(box[side], 4) for side in ("south", "north"))
    return f"{south} to {north}, {west} to {east}"


def checked_picture(file: Path, out: Path | None) -> Path:
    """Where the picture goes; ConfigError where it would not be a PNG."""
    picture = Path(f"{file.stem}.png") if out is None else out
    if picture.suffix.lower() != ".png":
        raise ConfigError(f"--out is {str(picture)!r}, expected a name that ends in .png")
    if picture.resolve() == file.resolve():
        raise ConfigError(f"--out is {str(picture)!r}, the map itself, expected another name")
    return picture


def drawn(part: Part, picture: Path, *, page: bool) -> tuple[list[str], str]:
    """Write the picture and, if wanted, the page beside it; their names, and how they differ from the map."""
    from terranav.app.mapview import map_page, map_png, view_of
    from terranav.io.files import replacing

    view, chart = view_of(part), part.chart
    written = [picture]
    with replacing(picture) as aside:
        aside.write_bytes(map_png(chart, view))
    if page:
        written.append(picture.with_suffix(".html"))
        with replacing(written[-1]) as aside:
            aside.write_text(map_page(chart, view), encoding="utf-8")
    return [str(file) for file in written], view.note


def fetched_facts(found: Sequence[Fetched], box: Box, cache: Path) -> dict[str, Any]:
    """What became of every tile."""
    from terranav.io.download import shown

    return {
        "box_deg": dict(zip(("south", "west", "north", "east"), box, strict=True)),
        "cache": str(cache),
        "counts": dict(Counter(one.state for one in found)),
        "bytes": sum(one.size for one in found),
        "tiles": [
            {
                "name": one.tile.name,
                "south_deg": one.tile.lat_deg,
                "west_deg": one.tile.lon_deg,
                "state": one.state,
                "bytes": one.size,
                "sha256": one.sha256 or None,
                "url": shown(one.tile.url),
            }
            for one in found
        ],
    }


def fetched_pairs(found: Sequence[Fetched], box: Box, cache: Path) -> list[tuple[str, str]]:
    """The same in words."""
    counts = ", ".join(f"{count} {state}" for state, count in Counter(one.state for one in found).items())
    missing = [one.tile.name for one in found if one.state == "missing"]
    more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
    return [
        ("box", _extent(dict(zip(("south", "west", "north", "east"), box, strict=True)))),
        ("tiles", f"{len(found)}: {counts}; {sum(one.size for one in found) / 1e6:.1f} MB"),
        *([("no such", ", ".join(missing[:8]) + more)] if missing else []),
        ("written to", str(cache)),
    ]
