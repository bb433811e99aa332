"""A map to look at: a picture of its relief, and a page to move about in that needs nothing but itself."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from terranav.app.polar import Polar, dress_polar, hull, polar_plane
from terranav.app.style import new_figure, png, styled
from terranav.app.trackmap import dress, hillshade
from terranav.app.words import distance
from terranav.core.earth import metres_per_degree
from terranav.core.errors import DataError

if TYPE_CHECKING:
    from terranav.io.thinning import Part
    from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

LONGEST = 1000  # samples along a side of what is drawn
_VOID = "#686d78"
_LEVELS = 65534  # heights of the page: two bytes each, 0 for void
_LAND = ["#2f6b4f", "#7fa86b", "#d8d49b", "#c79a62", "#9a6a4b", "#e9e2dc", "#ffffff"]
_SEA = ["#2a5c8f", "#3a7bab", "#5c9fc2", "#9acbd6", "#dcefe4"]
_FIELD = ["#2c5aa0", "#7fa7d0", "#f1f0ea", "#e0946f", "#a8323a"]
_RAMPS = {"terrain": _LAND, "bathymetry": _SEA}


@dataclass(frozen=True)
class View:
    """A map sampled on latitudes and longitudes, as it is drawn.

    Attributes
    ----------
    values : (rows, cols) [the map's unit]
        From the north-west corner; NaN where void or off the map.
    box : (south, west, north, east) [deg]
        Of the outer sides of the samples; low, left, high, right on the plane of `polar` where there is one.
    low, high : float
        What the ends of the colours stand for.
    shape : (rows, cols)
        Of the map.
    cell_m : float
        Of the map [m].
    means_of : (rows, cols)
        Cells of which means were taken first; (1, 1) where none were.
    thinned : bool
        There are fewer samples than cells.
    exact : bool
        Every sample is the value of a cell.
    polar : Polar or None
        What the rows and columns are steps of, where not latitude and longitude.
    """

    values: FloatArray
    box: tuple[float, float, float, float]
    low: float
    high: float
    shape: tuple[int, int]
    cell_m: float
    means_of: tuple[int, int]
    thinned: bool
    exact: bool
    polar: Polar | None = None

    @property
    def metres(self) -> tuple[float, float]:
        """Metres in a degree of the box, up and across."""
        if self.polar is not None:
            along = self.polar.metres_per_degree(self.box)
            return along, along
        up, across = metres_per_degree(0.5 * (self.box[0] + self.box[2]))
        return float(up), float(across)

    @property
    def note(self) -> str:
        """How the samples differ from the file, empty where they do not."""
        rows, cols = self.values.shape
        if self.means_of != (1, 1):
            down, across = self.means_of
            return (
                f"thinned to {rows} x {cols} samples of means of {down} x {across} cells: narrow features are flatter"
            )
        if self.thinned:
            return f"thinned to {rows} x {cols} samples: narrow features and single voids may be missing"
        onto = "latitude and longitude" if self.polar is None else "a plane around the pole"
        return "" if self.exact else f"resampled to {onto}, {rows} x {cols} samples"


def view_of(source: Map | Part, longest: int = LONGEST) -> View:
    """Sample a map on the hull of its cell centres, north up, at most `longest` samples along a side.

    Of a map with twice as many cells along a side or more, means of cells are sampled (`terranav.io.thinning`), so that
    light and shade are those of the land at that size and not of single cells.

    Raises
    ------
    DataError
        The map reaches beyond the poles: its coordinates are not those of its CRS. Or all of it is void.
    """
    from terranav.io.thinning import Part, part_of, thinned

    part = source if isinstance(source, Part) else part_of(source)
    place, name = part.place, part.chart.name
    south, _, north, _ = place.bounds_deg
    if south < -90.5 or north > 90.5:
        raise DataError(
            f"{name}: latitudes from {south:g} to {north:g} in {place.crs}, expected -90 to 90 or another --crs"
        )
    chart, means_of = thinned(part, longest)
    facts: dict[str, Any] = {"shape": part.shape, "cell_m": place.cell_m, "means_of": means_of}
    polar = polar_plane(chart)
    if polar is not None:
        return _polar_view(chart, polar, longest, facts)
    south, west, north, east = chart.bounds_deg
    rows, cols = (min(size, longest) for size in chart.shape)
    lat, lon = np.linspace(north, south, rows), np.linspace(west, east, cols)
    at_row, at_col = chart.cells(lat[:, None], lon[None, :])
    at = np.stack([at_row, at_col])
    exact = bool(np.isfinite(at).all() and np.abs(at - np.round(at)).max() < 1e-4)
    values = chart.sample(lat[:, None], lon[None, :])
    low, high = _range(values, chart)
    half_lat, half_lon = 0.5 * (north - south) / (rows - 1), 0.5 * (east - west) / (cols - 1)
    box = south - half_lat, west - half_lon, north + half_lat, east + half_lon
    return View(values, box, low, high, **facts, thinned=(rows, cols) != part.shape, exact=exact)


def _polar_view(chart: Map, polar: Polar, longest: int, facts: dict[str, Any]) -> View:
    """A map near a pole on the plane around it, in steps of a cell or more."""
    low, left, high, right = box = hull(chart, polar)
    least = facts["cell_m"] / polar.metres_per_degree(box)
    step = max(chart.cell_m / polar.metres_per_degree(box), max(right - left, high - low) / longest)
    rows, cols = (max(round(side / step), 2) for side in (high - low, right - left))
    y = high - (np.arange(rows) + 0.5) * (high - low) / rows
    x = left + (np.arange(cols) + 0.5) * (right - left) / cols
    values = chart.sample(*polar.earth(x[None, :], y[:, None]))
    return View(values, box, *_range(values, chart), **facts, thinned=step > 1.2 * least, exact=False, polar=polar)


def _range(values: FloatArray, chart: Map) -> tuple[float, float]:
    """What the ends of the colours stand for."""
    known = values[np.isfinite(values)]
    if not known.size:
        known = np.asarray(chart.values[~np.isnan(chart.values)])
    low, high = (float(value) for value in np.percentile(known, [0.5, 99.5]))
    return low, high if high > low else low + 1.0


def ramp(kind: str) -> Colormap:
    """The colours of a kind, from low to high."""
    return LinearSegmentedColormap.from_list(kind, _RAMPS.get(kind, _FIELD))


def relief(view: View, kind: str) -> FloatArray:
    """Heights in colour, lit from the north-west: (rows, cols, 4), transparent where void."""
    south, west, north, east = view.box
    rows, cols = view.values.shape
    known = np.isfinite(view.values)
    filled = _filled(view.values, known)
    per_lat, per_lon = view.metres
    light = hillshade(filled, (east - west) / cols * per_lon, (north - south) / rows * per_lat)
    scaled = np.clip((filled - view.low) / (view.high - view.low), 0.0, 1.0)
    picture = np.empty((rows, cols, 4))
    picture[..., :3] = ramp(kind)(scaled)[..., :3] * (0.4 + 0.6 * light)[..., None]
    picture[..., 3] = known
    return picture


def map_picture(chart: Map, view: View) -> Figure:
    """The relief with degrees along its sides, scale bar, north, colour bar and marked voids."""
    south, west, north, east = view.box
    with styled():
        per_lat, per_lon = view.metres
        tall = (north - south) * per_lat / ((east - west) * per_lon)
        width = float(np.clip(7.5 / max(tall, 1e-9), 4.5, 7.5))
        figure = new_figure(float(np.clip(width * tall, 1.5, 9.0)) + 1.6, width + 2.4)
        axes = figure.subplots()
        axes.set_facecolor(_VOID)
        axes.patch.set(hatch="////", edgecolor="#9aa0a9")
        picture = relief(view, chart.kind)
        axes.imshow(picture, extent=(west, east, south, north), origin="upper", aspect="auto", interpolation="nearest")
        axes.set(xlim=(west, east), ylim=(south, north))
        if view.polar is None:
            dress(axes, view.box)
        else:
            dress_polar(axes, view.box, view.polar)
        axes.set_title(_title(chart, view).replace(": ", "\n", 1), fontsize=10)
        scale = ScalarMappable(Normalize(view.low, view.high), ramp(chart.kind))
        bar = figure.colorbar(scale, ax=axes, extend="both", aspect=30, pad=0.02)
        bar.set_label(f"{chart.kind} [{chart.unit}]")
        remarks = [text for text in (_voids(view), view.note) if text]
        if remarks:
            axes.set_xlabel("\n".join(remarks), fontsize=8.5, loc="left", labelpad=8)
    return figure


def map_page(chart: Map, view: View) -> str:
    """The HTML page: relief and heights within it, nothing asked from anywhere."""
    from importlib.resources import files

    from jinja2 import Environment, StrictUndefined

    template = files("terranav.app").joinpath("templates/map.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    image = io.BytesIO()
    imsave(image, relief(view, chart.kind), format="png")
    packed, base, step = pack(view.values)
    rows, cols = view.values.shape
    colours = [
        f"rgb({', '.join(f'{100 * part:.1f}%' for part in ramp(chart.kind)(t)[:3])})" for t in np.linspace(0, 1, 9)
    ]
    data: dict[str, Any] = {
        "rows": rows,
        "cols": cols,
        "box": view.box,
        "base": base,
        "step": step,
        "unit": chart.unit,
        "metres": view.metres,
        "pole": None if view.polar is None else view.polar.sign,
        "turn": 0.0 if view.polar is None else view.polar.turn_deg,
        "heights": base64.b64encode(packed).decode(),
    }
    return environment.from_string(template).render(
        title=chart.name,
        facts=_title(chart, view),
        remarks=[text for text in (_voids(view), view.note) if text],
        image=base64.b64encode(image.getvalue()).decode(),
        data=data,
        colours=", ".join(colours),
        low=_short(view.low),
        high=f"{_short(view.high)} {chart.unit}",
    )


def pack(values: FloatArray) -> tuple[bytes, float, float]:
    """Values as two bytes each, little-endian: value = base + step (code - 1), 0 for void.

    Whole numbers stay exact; others are off by at most half a step, a 131,000th of the range.

    Returns
    -------
    codes, base, step
    """
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(values.shape, "<u2").tobytes(), 0.0, 1.0
    low, high = float(values[known].min()), float(values[known].max())
    whole = bool((values[known] == np.round(values[known])).all()) and high - low <= _LEVELS
    step = 1.0 if whole or high == low else (high - low) / _LEVELS
    codes = np.where(known, np.round((np.where(known, values, low) - low) / step) + 1.0, 0.0)
    return codes.astype("<u2").tobytes(), low, step


def map_png(chart: Map, view: View) -> bytes:
    """The picture as a PNG file."""
    return png(map_picture(chart, view), dpi=150)


def _filled(values: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """Voids with the nearest value, so that no shade falls from their edges."""
    if known.all():
        return values
    if not known.any():
        return np.zeros_like(values)
    from scipy.ndimage import distance_transform_edt

    row, col = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled: FloatArray = values[row, col]
    return filled


def _title(chart: Map, view: View) -> str:
    rows, cols = view.shape
    return f"{chart.name}: {rows} x {cols} cells of {distance(view.cell_m)}, datum {chart.datum or 'not stated'}"


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _voids(view: View) -> str:
    share = 1.0 - float(np.isfinite(view.values).mean())
    return f"hatched: void or off the map, {100 * share:.2g} % of the picture" if share else ""
