"""Geoid heights against published and finer ones, and what a datum that goes unnoticed costs a real flight.

    python -m benchmarks.datums heights --egm96 egm96_15.gtx --egm2008 EGM2008_geoid_h.nc [--finer egm96-5.pgm]
    python -m benchmarks.datums flight [--seeds 10]

No grid comes with terranav: `heights` needs files of yours (EGM2008 at 2.5 arcmin), and takes the finer EGM96 grid from
the package egm96 where none is given. `flight` needs the helicopter's data beside the checkout (or in the folder that
TERRANAV_SHARED names).
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.experiment.datums import DatumGuard
from terranav.experiment.inputs import prepare
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import fly
from terranav.io.geoid import find_geoid, open_geoid
from terranav.io.tables import convert_table
from terranav.maps.geoid import Geoid, Method

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("TERRANAV_SHARED", ROOT.parent / "shared")) / "data"
COLUMNS = ROOT / "examples" / "wisconsin_helicopter.toml"
METHODS: tuple[Method, Method] = ("bicubic", "bilinear")
DRAWN = 1_000_000
#: sample output of NGA's programs: latitude, longitude [deg], height [m]
EGM96 = (
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
)
EGM2008 = (
    (37.0, 241.0, -26.151),
    (37.0, -119.0, -26.151),
    (36.0, 242.983333, -29.171),
    (90.0, 0.0, 14.899),
    (-90.0, 359.983333, -30.150),
    (-90.0, 0.0, -30.150),
)


def centre(geoid: Geoid) -> float:
    """Longitude of the first column of a grid [deg]."""
    return geoid.transform[2] + 0.5 * geoid.transform[0]


def published(label: str, geoid: Geoid, table: tuple[tuple[float, float, float], ...]) -> None:
    """The largest difference from published heights."""
    for method in METHODS:
        worst = max(abs(float(geoid.height(lat, lon, method)) - height) for lat, lon, height in table)
        print(f"{label}, {method}: {1e3 * worst:.1f} mm at most of {len(table)} published heights")


def spacing(label: str, geoid: Geoid, finer: NDArray[np.float32], step_deg: float, every: int) -> None:
    """Heights between the nodes of a grid against those of a finer one that goes around the Earth from its west."""
    rng = np.random.default_rng(1)
    west = centre(geoid)
    row = rng.integers(1, finer.shape[0] - 1, DRAWN)
    col = rng.integers(0, round(360.0 / step_deg), DRAWN)
    between = (row % every > 0) | (col % every > 0)
    row, col = row[between], col[between]
    lat, lon = 90.0 - step_deg * row, west + step_deg * col
    weight = np.cos(np.radians(lat))
    for method in METHODS:
        off = geoid.height(lat, lon, method) - finer[row, col]
        rms = np.sqrt(np.average(off**2, weights=weight))
        print(
            f"{label}, {method}: rms {1e3 * rms:.1f} mm, at most {1e3 * np.abs(off).max():.0f} mm of {row.size} nodes"
        )


def heights(given: argparse.Namespace) -> None:
    """Print what the grids that are given are worth."""
    old, new = open_geoid(given.egm96, datum="EGM96"), open_geoid(given.egm2008, datum="EGM2008")
    published("EGM96", old, EGM96)
    published("EGM2008", new, EGM2008)
    finer = find_geoid("EGM96") if given.finer is None else open_geoid(given.finer, datum="EGM96")
    if finer is not None and finer.transform[0] < old.transform[0]:
        published(f"EGM96 of {finer.source}", finer, EGM96)
        every = round(old.transform[0] / finer.transform[0])
        whole = finer.read(((0, finer.shape[0]), (0, finer.shape[1])))
        turned = round((centre(old) - centre(finer)) / finer.transform[0])
        rolled = np.roll(whole[:, : round(360.0 / finer.transform[0])], -turned, axis=1)
        spacing("EGM96 between its nodes", old, rolled, finer.transform[0], every)
    step = new.transform[0]
    whole = new.read(((0, new.shape[0]), (0, new.shape[1])))
    a, _, west, _, e, north = new.transform
    thin = (2 * a, 0.0, west - 0.5 * a, 0.0, 2 * e, north - 0.5 * e)
    spacing("EGM2008 thinned by two", Geoid.from_values(whole[::2, ::2], thin, "EGM2008"), whole, step, 2)


def flight(given: argparse.Namespace) -> None:
    """Print the DRMS of a flight over its map with heights that are, and are not, what they are taken for."""
    warnings.simplefilter("ignore")
    track = convert_table(DATA / "wisconsin_helicopter" / "flight_20210125.csv", COLUMNS)
    chart = replace(tn.open_map(DATA / "wisconsin_helicopter" / "land_surface_100m.tif"), datum="EGM2008")
    guard = DatumGuard(open_geoid(DATA / "gravity" / "egm2008_2p5min_wisconsin_ne.nc"))
    added = guard.find("EGM2008").height(track.lat_deg, track.lon_deg)  # type: ignore[union-attr]
    print(f"geoid heights along the track: {added.min():.2f} to {added.max():.2f} m")
    for method in ("pointmass", "marginalized"):
        for label, lift, datum in (
            ("as published", 0.0, {}),
            ("ellipsoidal, not named", 1.0, {}),
            ("ellipsoidal, named", 1.0, {"all": "ellipsoid"}),
        ):
            found = []
            for seed in range(given.seeds):
                drifted = tn.add_drift(track, tn.InsGrade(500.0, 0.5), seed)
                lifted = drifted.with_columns(terrain_m=drifted.columns["terrain_m"] + lift * added)
                inputs = prepare(replace(lifted, datum=datum), chart, None, None, needs_maps=True, guard=guard)
                built = make_estimator(method, inputs.maps, inputs.ins)
                found.append(fly(built, inputs, seed).metrics()["drms_m"])
            middle, low, high = median_with_interval(np.array(found))
            print(
                f"{method}, {label}: median DRMS {middle:.0f} m [{low:.0f}, {high:.0f}], {given.seeds} runs", flush=True
            )


def main() -> int:
    """Do one of the two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    grids = parts.add_parser("heights")
    grids.add_argument("--egm96", type=Path, required=True)
    grids.add_argument("--egm2008", type=Path, required=True)
    grids.add_argument("--finer", type=Path, help="a finer grid of EGM96")
    parts.add_parser("flight").add_argument("--seeds", type=int, default=10)
    given = parser.parse_args()
    (heights if given.part == "heights" else flight)(given)
    return 0


if __name__ == "__main__":
    sys.exit(main())
