"""The same answers on other machines: an older processor, one core, no compiler, nowhere to write."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import terranav

FLIGHT = """
import sys
import numpy as np
import terranav as tn
from terranav.core.earth import shift

assert tn.__file__.startswith(tuple(sys.argv[4:]) or tn.__file__)  # the package that was meant
names, epochs, cells = sys.argv[1].split(","), int(sys.argv[2]), int(sys.argv[3])
rng = np.random.default_rng(4)
hills = rng.normal(0.0, 60.0, (64, 64))
for axis in (0, 1):
    hills = hills + np.roll(hills, 1, axis) + np.roll(hills, 2, axis)
hills[40, 12] = np.nan
chart = tn.Map(300.0 + hills, (0.001, 0.0, 8.0, 0.0, -0.001, 47.0), sigma=2.0)
time_s = np.arange(float(epochs))
lat, lon = shift(46.97, 8.02, 25.0 * time_s, 40.0 * time_s)
seen_lat, seen_lon = shift(lat, lon, 60.0 + 0.3 * time_s, -45.0)
columns = {"time_s": time_s, "lat_deg": seen_lat, "lon_deg": seen_lon, "alt_m": np.full(epochs, 900.0)}
columns["terrain_m"] = chart.sample(lat, lon) + rng.normal(0.0, 2.0, epochs)
rec = tn.Recording(columns, sigma={"terrain_m": 2.0})
settings = {
    "pointmass": {"max_cells": cells},
    "particle": {"particles": cells},
    "marginalized": {"particles": cells, "least_particles": cells},
}
for name in names:
    result = tn.run(name, rec, chart, seed=3, ins=tn.InsGrade(100.0, 0.3, 0.1), **settings.get(name, {}))
    print(*result.ins_error_m.ravel().tolist(), *result.cov_m2.ravel().tolist())
"""
METHODS = "pointmass,particle,marginalized,viterbi,sitan,fading_memory"


def flown(*arguments: str, **environment: str) -> NDArray[np.float64]:
    """Estimates and covariances of each method, one row each, from a process of its own."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, *arguments],
        env=inherited | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])


def test_a_processor_without_avx512_gives_the_same_answers(tmp_path: Path) -> None:
    here = flown(METHODS, "24", "4000")
    older = flown(METHODS, "24", "4000", NUMBA_CPU_NAME="x86-64-v3", NUMBA_CACHE_DIR=str(tmp_path))
    np.testing.assert_allclose(older, here, rtol=1e-6, atol=1e-7)
    assert np.isfinite(here).all()
    assert here.shape == (6, 24 * 6)


def test_one_core_gives_the_same_bits() -> None:
    alone = flown("pointmass,particle", "24", "4000", NUMBA_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    np.testing.assert_array_equal(alone, flown("pointmass,particle", "24", "4000"))


def test_without_compilation_the_answers_are_right() -> None:
    np.testing.assert_allclose(
        flown("pointmass,particle,marginalized", "5", "500", NUMBA_DISABLE_JIT="1"),
        flown("pointmass,particle,marginalized", "5", "500"),
        rtol=1e-6,
        atol=1e-7,
    )


def test_a_read_only_package_and_home(tmp_path: Path) -> None:
    """Nowhere to keep compiled kernels: they are compiled for this process alone.

    A plain file where the cache folder would be stands in for missing permissions: it stops the superuser, too.
    """
    skipped = shutil.ignore_patterns("__pycache__")
    package = shutil.copytree(Path(terranav.__file__).parent, tmp_path / "terranav", ignore=skipped)
    for folder in [package, *(place for place in package.rglob("*") if place.is_dir())]:
        (folder / "__pycache__").touch()
    home = tmp_path / "home"
    home.touch()
    nowhere = {"PYTHONPATH": str(tmp_path), "HOME": str(home), "XDG_CACHE_HOME": str(home)}
    there = flown("pointmass", "12", "4000", str(package), **nowhere)
    assert not list(tmp_path.rglob("*.nbi"))
    np.testing.assert_array_equal(there, flown("pointmass", "12", "4000"))
