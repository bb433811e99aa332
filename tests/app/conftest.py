"""A small flight over the sample DEM: as objects, as files, and as a hand-made outcome that needs no estimator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from terranav.app.outcome import Outcome
from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Posterior
from terranav.experiment.result import Result
from terranav.ins.drift import add_drift
from terranav.io.recordings import write_recording
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

INS = InsGrade(300.0, 1.0, 0.5)
EPOCHS = 120


@dataclass(frozen=True)
class Flight:
    """Files of one flight."""

    recording: Path
    no_truth: Path
    true_position: Path
    map: Path

    @property
    def arguments(self) -> list[str]:
        return ["--recording", str(self.recording), *self.map_arguments]

    @property
    def map_arguments(self) -> list[str]:
        return ["--map", str(self.map), "--map-crs", "EPSG:4326"]


@pytest.fixture(scope="session")
def chart() -> Map:
    return sample_map().crop(36.52, -84.34, 36.66, -84.14)


@pytest.fixture(scope="session")
def true_flight(chart: Map) -> Recording:
    """A recording whose position is true."""
    time_s = 2.0 * np.arange(EPOCHS)
    lat = 36.56 + 0.0004 * np.arange(EPOCHS)
    lon = -84.30 + 0.001 * np.arange(EPOCHS)
    noise = np.random.default_rng(3).normal(0.0, 3.0, EPOCHS)
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(EPOCHS, 1500.0)}
    return Recording({**columns, "terrain_m": chart.sample(lat, lon) + noise}, sigma={"terrain_m": 3.0}, name="hop")


@pytest.fixture(scope="session")
def recording(true_flight: Recording) -> Recording:
    return add_drift(true_flight, INS, 5)


@pytest.fixture(scope="session")
def flight(
    tmp_path_factory: pytest.TempPathFactory, chart: Map, true_flight: Recording, recording: Recording
) -> Flight:
    folder = tmp_path_factory.mktemp("flight")
    blind = Recording(
        {key: value for key, value in recording.columns.items() if not key.startswith("true_")},
        ins=INS,
        sigma=recording.sigma,
        name="blind",
    )
    files = Flight(folder / "hop.csv", folder / "blind.csv", folder / "gnss.csv", folder / "hills.asc")
    for rec, path in ((recording, files.recording), (blind, files.no_truth), (true_flight, files.true_position)):
        write_recording(rec, path)
    write_ascii(chart, files.map)
    return files


def write_ascii(chart: Map, path: Path) -> None:
    """Write a geographic map as an ESRI ASCII grid, which states no CRS."""
    a, _, west, _, e, north = chart.transform
    head = {
        "ncols": chart.shape[1], "nrows": chart.shape[0],
        "xllcorner": west, "yllcorner": north + e * chart.shape[0], "cellsize": a,
    }  # fmt: skip
    lines = [f"{key} {value!r}" for key, value in head.items()]
    lines += [" ".join(f"{value:.2f}" for value in row) for row in chart.values.tolist()]
    path.write_text("\n".join(lines) + "\n")


def made_up_result(rec: Recording, name: str, error_m: float, status: list[str], *, particles: bool = False) -> Result:
    """A result whose estimate lies `error_m` north of the truth and claims a sigma of 20 m."""
    n = len(rec)
    true = rec.ins_error_m()
    ins_error = np.zeros((n, 2)) if name == "ins" else true - [error_m, 0.0]
    lat, lon = shift(rec.lat_deg, rec.lon_deg, -ins_error[:, 0], -ins_error[:, 1])
    north, east = ins_error[-1, 0] + np.linspace(-60, 60, 25), ins_error[-1, 1] + np.linspace(-60, 60, 25)
    weight = np.exp(-0.5 * ((north[:, None] - north[12]) ** 2 + (east[None, :] - east[12]) ** 2) / 400.0)
    belief = Posterior(north, east, weight / weight.sum())
    if particles:
        rng = np.random.default_rng(1)
        cloud = ins_error[-1][:, None] + rng.normal(0.0, 20.0, (2, 300))
        belief = Posterior(cloud[0], cloud[1], np.full(300, 1 / 300))
    return Result(
        estimator=name,
        time_s=rec.time_s,
        lat_deg=lat,
        lon_deg=lon,
        alt_m=rec.alt_m,
        status=np.array(status, dtype=np.str_),
        ins_error_m=ins_error,
        cov_m2=np.tile(np.eye(2) * (90000.0 if name == "ins" else 400.0), (n, 1, 1)),
        nis=np.ones(n),
        indicated_lat_deg=rec.lat_deg,
        indicated_lon_deg=rec.lon_deg,
        true_lat_deg=rec.columns["true_lat_deg"],
        true_lon_deg=rec.columns["true_lon_deg"],
        posterior=None if name == "ins" else belief,
        map_cell_m=80.0,
        provenance={"seed": 4, "versions": {"numpy": "2"}, "estimator": {"settings": {"cells": 3}}, "wall_s": 0.5},
        name=rec.name,
    )


@pytest.fixture(scope="session")
def outcome(recording: Recording, chart: Map) -> Outcome:
    """INS alone and an estimator that is 10 m off, fixed after 20 epochs."""
    fixed = ["searching"] * 20 + ["converged"] * (EPOCHS - 30) + ["degraded"] * 10
    results = {
        "ins": made_up_result(recording, "ins", 0.0, ["searching"] * EPOCHS),
        "pointmass": made_up_result(recording, "pointmass", 10.0, fixed),
    }
    return Outcome(recording, (chart,), results, INS, seed=4, command="terranav run <&>")
