"""terranav reproduce: made-up papers stand in for the real ones, so that what is tested is the command."""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from rich.console import Console

import terranav.experiment.papers as package
from terranav.app import paper_figures, reproducing, studies
from terranav.app.cli import main
from terranav.app.reproduction import Attempt, numeric_columns, print_parts, shown, summary
from terranav.app.style import MAIN, png
from terranav.core.errors import DataWarning
from terranav.experiment.papers.outcome import Claim, Figure, Reproduction, Series, Setup, Table
from terranav.io import rasters
from terranav.maps.map import Map
from tests.app.conftest import Flight
from tests.app.test_cli import answered, refused, run_python

GOOD = """
import numpy as np
from terranav.experiment.montecarlo import Failure, bootstrap, monte_carlo
from terranav.experiment.papers.outcome import Claim, Figure, Reproduction, Series, Table

TITLE = "A [made-up] method <for> tests"


def reproduce(setup):
    def one(k, seed):
        if k == 2:
            raise ValueError("run 2 never works")
        return float(np.random.default_rng(seed).normal(50.0, 1.0))

    found, failures = monte_carlo(one, setup.runs, seed=setup.seed, executor=setup.executor, on_run=setup.on_run)
    mean = bootstrap(np.array(found))
    x = np.arange(5.0)
    y = np.array([1.0, np.nan, 3.0, np.nan, 0.0])
    maps = ", ".join(f"{chart.name} {chart.kind}" for chart in setup.maps) or "default"
    return Reproduction(
        "000", TITLE, f"A line of 5 points; maps: {maps}.", setup.runs,
        (Table("The paper's table", ("method", "paper [m]", "ours [m]"), (("x", "50.16", mean.text(3)),)),),
        (
            Claim("It is <good>", "50.16 m", mean.text(3), "holds", "because [it] is"),
            Claim("It is better", "30 m", "40 m", "holds in part", ""),
            Claim("It is best", "20 m", "40 m", "does not hold", "it is not"),
        ),
        (Figure("line", "A line & a band", "x", "y", (Series("a", x, y, y - 1, y + 1),), log_y=True),),
        failures,
    )
"""
BAD = """
from terranav.core.errors import ConfigError
TITLE = "A method that cannot"
def reproduce(setup):
    raise {error}
"""


@pytest.fixture
def shelve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put the sources given by number in place of the real papers."""
    folder = tmp_path / "papers"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(package, "__path__", [str(folder)])
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # one paper after the other, here, where they are known

    def put(**sources: str) -> None:
        for name, source in sources.items():
            (folder / f"{name}.py").write_text(source)
            monkeypatch.delitem(sys.modules, f"{package.__name__}.{name}", raising=False)
        importlib.invalidate_caches()

    return put


@pytest.fixture
def good(shelve: Callable[..., None]) -> None:
    shelve(p000=GOOD)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["005"], "no paper '005', expected one of 000"),
        (["000", "al"], "no paper 'al', expected one of 000"),
        (["all", "--runs", "1"], "--runs is 1, expected a finite number and >= 2"),
        (["all", "--runs", "few"], "'--runs'"),
        (["000", "--seed", "-1"], "--seed is -1, expected a finite number and >= 0"),
        (["000", "--workers", "0"], "--workers is 0, expected a finite number and >= 1"),
        (["000", "--map", "nowhere.tif"], "nowhere.tif: no such file"),
        (["000", "--map-kind", "gravity"], "--map-kind is given without --map"),
        (["000", "--out", "papers/p000.py"], "--out papers/p000.py: is a file, expected a folder"),
        (["000", "--out", "papers/p000.py/below"], "--out papers/p000.py/below: cannot be written"),
    ],
)
def test_wrong_use_is_one_line_before_anything_runs(
    good: None, arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(studies, "reproduce", lambda *_: pytest.fail("a study was started"))
    assert expected in refused(capsys, "reproduce", *arguments)
    assert not Path(reproducing.DEFAULT_FOLDER).exists()


def test_bad_maps_are_refused(good: None, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = ["--map", flight.map, "--map-crs", "EPSG:4326", "--map-kind", "terain"]
    assert "did you mean 'terrain'?" in refused(capsys, "reproduce", "000", *wrong)
    (tmp_path / "text.tif").write_text("no raster")
    assert "text.tif" in refused(capsys, "reproduce", "000", "--map", "text.tif")


def test_help_is_fast_and_lists_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--runs", "--seed", "--map", "--workers", "--json", "--out"))
    done = run_python(
        "-c", "from terranav.app.cli import main; main(['reproduce', '-h']); import sys; print(*sys.modules)"
    )
    loaded = {name.split(".")[0] for name in done.stdout.splitlines()[-1].split()}
    assert loaded & {"numba", "numpy", "matplotlib", "scipy", "rasterio", "pandas", "jinja2"} == set()


def test_one_paper_prints_its_tables_and_claims(good: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "0", "--runs", "4"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for text in (
        "000  A [made-up] method <for> tests",
        "A line of 5 points; maps: default.",
        "4 runs of each case",
        "1 failed (run 2: ValueError: run 2 never works)",
        "The paper's table",
        "50.16",
        "does not hold",
        "why: because [it] is",
        "3 claims of 1 paper: 1 holds, 1 holds in part, 1 does not.",
    ):
        assert text in out
    assert "\x1b" not in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["papers"]


def test_same_seed_same_figures_for_any_number_of_workers(good: None, capsys: pytest.CaptureFixture[str]) -> None:
    def ours(*more: str) -> str:
        found = answered(capsys, "reproduce", "000", "--runs", "6", "--json", *more)
        return str(found["papers"]["000"]["tables"][0]["rows"][0][2])

    assert ours("--workers", "1") == ours("--workers", "3") == ours()
    assert ours("--seed", "1") != ours()


def test_json_on_stdout_is_what_is_written(good: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, "reproduce", "000", "--runs", "3", "--json", "--out", "kept")
    assert found == json.loads((tmp_path / "kept" / "reproduction.json").read_text())
    assert found["verdicts"] == {"holds": 1, "holds in part": 1, "does not hold": 1, "failed": 0}
    assert (found["runs"], found["seed"], found["maps"]) == (3, 0, [])
    paper = found["papers"]["000"]
    assert paper == json.loads((tmp_path / "kept" / "000.json").read_text())
    assert paper["error"] is None
    assert paper["failures"] == [{"run": 2, "error": "ValueError: run 2 never works"}]
    assert paper["claims"][0]["verdict"] == "holds"
    assert paper["figures"] == [{"name": "line", "title": "A line & a band"}]
    names = {"000.json", "000-line.csv", "000-line.png", "reproduction.html", "reproduction.json"}
    assert {path.name for path in (tmp_path / "kept").iterdir()} == names
    page = (tmp_path / "kept" / "reproduction.html").read_text()
    assert "It is &lt;good&gt;" in page
    assert page.count("data:image/png;base64,") == 1
    assert "http" not in page.replace("https://", "http://").replace("data:", "")


def test_a_paper_that_fails_is_reported_in_its_place(
    shelve: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = "import nothing_of_this_name"
    shelve(p000=GOOD, p001=BAD.format(error="RuntimeError('no\\nluck')"), p002=broken, p003=GOOD)
    assert main(["reproduce", "all", "--runs", "2"]) == 1
    out, err = capsys.readouterr()
    assert err.splitlines() == [
        "terranav: error: paper 001: RuntimeError: no luck",
        "terranav: error: paper 002: ModuleNotFoundError: No module named 'nothing_of_this_name'",
    ]
    assert "6 claims of 2 papers: 2 hold, 2 hold in part, 2 do not; 2 papers could not be run." in out
    folder = tmp_path / reproducing.DEFAULT_FOLDER
    found = json.loads((folder / "reproduction.json").read_text())
    assert list(found["papers"]) == ["000", "001", "002", "003"]
    assert found["papers"]["001"]["error"] == "RuntimeError: no luck"
    assert "in reproduce" in found["papers"]["001"]["traceback"]
    assert found["papers"]["003"]["claims"] == found["papers"]["000"]["claims"]
    assert "RuntimeError: no luck" in (folder / "reproduction.html").read_text()


def test_a_paper_that_cannot_use_the_maps_is_wrong_input(
    shelve: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    shelve(p002=BAD.format(error="ConfigError('--map: terrain only, expected a gravity map too')"))
    assert refused(capsys, "reproduce", "002") == "--map: terrain only, expected a gravity map too"


def test_each_paper_is_kept_before_the_next_begins(
    shelve: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shelve(p000=GOOD, p001=BAD.format(error="KeyboardInterrupt"))
    assert main(["reproduce", "--runs", "2"]) == 130
    assert "stopped" in capsys.readouterr().err
    folder = tmp_path / reproducing.DEFAULT_FOLDER
    assert list(json.loads((folder / "reproduction.json").read_text())["papers"]) == ["000"]
    assert "Not run yet: 001" in (folder / "reproduction.html").read_text()


def test_a_picture_that_cannot_be_drawn_costs_only_itself(
    good: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def spilled(_: Figure) -> None:
        raise ValueError("no ink")

    monkeypatch.setattr(paper_figures, "draw", spilled)
    assert main(["reproduce", "000", "--runs", "2", "--out", "kept"]) == 1
    out, err = capsys.readouterr()
    assert err == "terranav: error: paper 000: not everything was written to kept (ValueError: no ink)\n"
    assert "3 claims" in out
    assert {"000.json", "000-line.csv", "reproduction.html"} <= {path.name for path in (tmp_path / "kept").iterdir()}


def test_maps_are_opened_once_and_reach_every_paper(
    shelve: Callable[..., None], flight: Flight, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shelve(p000=GOOD, p001=GOOD)
    opened: list[object] = []
    really = rasters.open_map

    def counted(path: Path, **more: Any) -> Map:
        opened.append(path)
        return really(path, **more)

    monkeypatch.setattr(rasters, "open_map", counted)
    found = answered(capsys, "reproduce", "000", "001", "0", "--runs", "2", "--json", *flight.map_arguments)
    assert opened == [flight.map]
    assert [chart["name"] for chart in found["maps"]] == ["hills.asc"]
    assert all("maps: hills.asc terrain" in paper["scenario"] for paper in found["papers"].values())
    assert len(found["papers"]) == 2


def test_progress_has_a_bar_for_each_paper(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with studies.progress() as none, none.aside():
        assert none.on_run is None
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with studies.progress() as bars:
        assert bars.on_run is not None
        for done in (1, 2, 3, 1, 2):
            bars.on_run("000", done, 3)
            bars.on_run("001", 2 * done, 6)
        with bars.aside():
            sys.stdout.write("a table\n")
    out, err = capsys.readouterr()
    assert out == "a table\n"
    assert "paper 000, study 2" in err
    assert "4/6" in err


def stand_in(number: str, setup: Setup) -> Attempt:
    """A study for a process of its own: 000 waits for the others and warns, 001 dies, 002 reports its runs."""
    if number == "000":
        while not Path(setup.maps[0].name).exists():
            time.sleep(0.01)
        for _ in range(2):
            warnings.warn("doubtful", DataWarning, stacklevel=1)
    if number == "001":
        os._exit(3)
    if number == "002":
        for done in (1, 2):
            assert setup.on_run is not None
            setup.on_run(done, 2)
        Path(setup.maps[0].name).touch()
    return Attempt(number, f"seed {setup.seed}", 0.0)


def test_papers_run_side_by_side_and_one_that_dies_costs_only_itself(
    tmp_path: Path, chart: Map, capsys: pytest.CaptureFixture[str]
) -> None:
    setup = Setup(seed=6, maps=(replace(chart, name=str(tmp_path / "flag")),))
    seen: list[tuple[str, int, int]] = []
    found = list(studies.side_by_side(stand_in, ["000", "001", "002"], setup, 2, lambda *run: seen.append(run)))
    assert found[0].paper == "001"  # 002 begins when it is gone, and ends together with 000
    assert sorted(attempt.paper for attempt in found) == ["000", "001", "002"]
    assert found[0].error == "its process ended with status 3 before it was done"
    assert [attempt.title for attempt in found[1:]] == ["seed 6", "seed 6"]
    assert seen == [("002", 1, 2), ("002", 2, 2)]
    assert capsys.readouterr().err == "terranav: warning: doubtful\n"


def test_whoever_stops_reading_ends_the_studies(tmp_path: Path, chart: Map) -> None:
    setup = Setup(maps=(replace(chart, name=str(tmp_path / "flag")),))
    reader = studies.side_by_side(stand_in, ["000", "001"], setup, 2)
    assert next(reader).paper == "001"
    del reader
    for process in active_children():
        process.join(10)
    assert active_children() == []


def test_tables_come_in_order_whichever_paper_is_first(
    good: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def backwards(numbers: list[str], *_: object) -> Iterator[Attempt]:
        for number in reversed(numbers):
            yield Attempt(number, f"paper {number}", 1.0, error="none of this name" if number == "001" else "")
            kept = json.loads((tmp_path / "kept" / "reproduction.json").read_text())["papers"]
            assert list(kept) == [one for one in numbers if one >= number]

    monkeypatch.setattr(reproducing, "attempts", backwards)
    task = reproducing.Task(["000", "001", "002"], Setup(2), tmp_path / "kept", processes=2)
    (tmp_path / "kept").mkdir()
    assert reproducing.conclude(task) == 1
    out = capsys.readouterr().out
    assert out.index("paper 000") < out.index("paper 001") < out.index("paper 002")


def test_stopped_while_an_earlier_paper_runs_shows_what_is_done(
    good: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> Iterator[Attempt]:
        yield Attempt("001", "the second paper", 1.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(reproducing, "attempts", stopped)
    with pytest.raises(KeyboardInterrupt):
        reproducing.conclude(reproducing.Task(["000", "001"], Setup(2)))
    assert "the second paper" in capsys.readouterr().out


def _figure(kind: str, *series: Series, log_y: bool = False) -> Figure:
    return Figure("f", "F", "x [m]", "y [m]", series, kind, log_y)  # type: ignore[arg-type]


def _series(label: str, y: list[float], band: float = 0.0) -> Series:
    values = np.array(y)
    limits = (values - band, values + band) if band else (None, None)
    return Series(label, np.arange(float(len(y))), values, *limits)


def test_lines_break_at_gaps_and_lone_values_are_dots() -> None:
    drawn = paper_figures.draw(_figure("lines", _series("a", [1.0, np.nan, 2.0, 3.0, np.nan, 4.0], 0.5)))
    line, dots = drawn.axes[0].lines
    assert np.isnan(np.asarray(line.get_ydata(), dtype=float)).tolist() == [False, True, False, False, True, False]
    assert np.asarray(dots.get_xdata()).tolist() == [0.0, 5.0]
    assert len(drawn.axes[0].collections) == 1


def test_bars_stand_side_by_side_around_their_centres() -> None:
    drawn = paper_figures.draw(_figure("bars", _series("a", [1.0, 2.0]), _series("b", [3.0, 4.0], 1.0)))
    boxes = [patch.get_bbox() for patch in drawn.axes[0].patches if isinstance(patch, Rectangle)]
    a0, a1, b0, b1 = [0.5 * (box.x0 + box.x1) for box in boxes]
    assert (a0 + b0) / 2 == pytest.approx(0.0)
    assert (a1 + b1) / 2 == pytest.approx(1.0)
    assert boxes[0].x1 == pytest.approx(boxes[2].x0)


@pytest.mark.parametrize("kind", ["lines", "points"])
def test_a_limit_is_a_dashed_line(kind: str) -> None:
    limit, data = _series("limit", [2.0, 2.0, 2.0]), _series("a", [1.0, 3.0, 2.0])
    lines = paper_figures.draw(_figure(kind, limit, data)).axes[0].lines
    drawn = {str(line.get_label()): line for line in lines}
    assert drawn["limit"].get_linestyle() == "--"
    assert drawn["a"].get_color() == MAIN


def test_a_logarithmic_axis_leaves_out_what_is_not_positive() -> None:
    drawn = paper_figures.draw(_figure("lines", _series("a", [1.0, 0.0, 10.0, 20.0], 5.0), log_y=True))
    axes = drawn.axes[0]
    assert axes.get_yscale() == "log"
    assert np.isnan(np.asarray(axes.lines[0].get_ydata(), dtype=float)).tolist() == [False, True, False, False]
    assert axes.get_ylim()[0] > 0.0


def test_a_cloud_of_two_lengths_keeps_its_shape() -> None:
    cloud = Series("a", np.array([-90.0, 100.0]), np.array([-50.0, 60.0]))
    drawn = paper_figures.draw(Figure("f", "F", "east [m]", "north [m]", (cloud,), "points"))
    assert drawn.axes[0].get_aspect() == 1.0
    drawn = paper_figures.draw(Figure("f", "F", "east [m]", "slope [deg]", (cloud,), "points"))
    assert drawn.axes[0].get_aspect() == "auto"


@pytest.mark.parametrize("kind", ["lines", "points", "bars"])
@pytest.mark.parametrize("log_y", [False, True])
@pytest.mark.parametrize(
    "series",
    [
        (),
        (_series("nothing", [np.nan, np.nan]),),
        (_series("one", [3.0]),),
        (_series("", [1.0, 2.0], 0.1), _series("b", [np.nan, 2.0])),
        tuple(_series(f"a rather long label, number {i}", list(np.arange(i, i + 60.0)), 2.0) for i in range(9)),
    ],
    ids=["none", "all gaps", "one value", "two", "many"],
)
@pytest.mark.filterwarnings("error")
def test_every_kind_of_figure_is_drawn(kind: str, log_y: bool, series: tuple[Series, ...]) -> None:
    assert png(paper_figures.draw(_figure(kind, *series, log_y=log_y)), dpi=40).startswith(b"\x89PNG")


def test_the_data_of_a_figure_as_csv() -> None:
    text = paper_figures.data_csv(_figure("lines", _series("a, b", [1.0, np.nan]), _series("c", [0.1], 0.5)))
    assert text.splitlines() == ["series,x,y,low,high", '"a, b",0.0,1.0,,', '"a, b",1.0,,,', "c,0.0,0.1,-0.4,0.6"]
    assert paper_figures.data_csv(_figure("bars", _series("a", [1.0]))) == "series,x,y\na,0.0,1.0\n"


def test_columns_of_figures_go_to_the_right() -> None:
    rows = (("1", "50.16", "–", "no"), ("2", "-3 (-4..-2)", "", "1"))
    words = (("1", "as printed"), ("2", "1 start"), ("3", "none"))
    assert numeric_columns(Table("", ("n", "a"), words)) == [False, False]
    assert numeric_columns(Table("", ("n", "a", "b", "c"), rows)) == [False, True, True, True]
    assert numeric_columns(Table("", ("n", "a"), ())) == [False, True]


def test_tables_are_whole_in_a_file_and_lose_nothing_on_a_narrow_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    cells = tuple(f"{i}.123 (-0.{i}00..0.{i}99)" for i in range(8))
    table = Table("T", ("map", *(f"column {i}" for i in range(8))), (("a field of [gravity]", *cells),))
    attempt = Attempt("000", "", 1.0, Reproduction("000", "", "", 2, (table,), ()))
    print_parts(*shown(attempt))
    out = capsys.readouterr().out
    assert all(cell in out for cell in (*cells, "a field of [gravity]"))
    assert all(line == line.rstrip() for line in out.splitlines())
    narrow = io.StringIO()
    Console(file=narrow, width=70).print(*shown(attempt, 70))
    assert "…" not in narrow.getvalue()
    assert sum(narrow.getvalue().count(digit) for digit in "0123456789") == sum(map(out.count, "0123456789"))


def test_summary_in_the_singular() -> None:
    found = Reproduction("000", "", "", 2, (), (Claim("", "", "", "does not hold", ""),))
    assert summary([Attempt("000", "", 1.0, found)]) == "1 claim of 1 paper: 0 hold, 0 hold in part, 1 does not."
    assert summary([Attempt("000", "", 1.0, error="x")]).endswith("1 paper could not be run.")


def test_page_without_pictures_still_says_everything() -> None:
    found = Reproduction("000", "T", "S", 2, (), (Claim("C", "1", "2", "holds in part", "W"),))
    task = reproducing.Task(["000"], Setup(2), command="terranav reproduce 000")
    page = reproducing.page(task, [Attempt("000", "T", 1.0, found)], {})
    assert all(text in page for text in ("holds in part", "<dd>W</dd>", "terranav reproduce 000", "default ones"))
