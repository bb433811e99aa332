"""The runner: the same figures for any workers, chunks and kills; foreign folders; runs and processes that fail."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataWarning, StateError
from terranav.experiment.montecarlo import Threads
from terranav.experiment.processes import Processes
from terranav.experiment.studies.runner import Prepared, StudyResult, prepare_study, report_facts, run_study
from terranav.experiment.studies.study import CaseRuns, Setup
from tests.experiment.studies import fakes

HERE = Threads(1)


def prepared(run: Any = fakes.run, runs: int | None = None, seed: int = 3, **changes: Any) -> Prepared:
    return prepare_study(fakes.study(run, **changes), Setup(seed=seed), runs)


def figures(result: StudyResult) -> Any:
    return report_facts(result.report)


def test_figures_do_not_depend_on_workers_or_chunks(tmp_path: Path) -> None:
    here = run_study(prepared(), tmp_path / "here", executor=HERE)
    apart = run_study(prepared(), tmp_path / "apart", executor=Processes(2))
    large = run_study(prepared(chunk=50), tmp_path / "large", executor=HERE)
    assert figures(here) == figures(apart) == figures(large)
    assert (here.runs, here.ran, here.failed) == (12, 12, 0)
    other = run_study(prepared(seed=4), tmp_path / "other", executor=HERE)
    assert figures(other) != figures(here)


def test_a_run_depends_on_nothing_but_its_seed_case_and_number(tmp_path: Path) -> None:
    seen: list[CaseRuns] = []

    def kept(cases: Any) -> Any:
        seen.extend(cases)
        return fakes.report(cases)

    for runs in (3, 6):
        study = fakes.study()
        object.__setattr__(study, "report", kept)
        run_study(prepare_study(study, Setup(seed=3), runs), tmp_path / str(runs), executor=HERE)
    np.testing.assert_array_equal(seen[0]["value"], seen[2]["value"][:3])
    assert np.isnan(seen[0]["extra"]).all()  # this case has no such figure
    assert (seen[1]["extra"] == 1.0).all()
    assert not np.array_equal(seen[0]["value"], seen[1]["value"] - 4.0)  # cases do not share their draws


def test_what_is_done_is_not_run_again(tmp_path: Path) -> None:
    whole = run_study(prepared(), tmp_path / "out", executor=HERE)
    (tmp_path / "out" / "chunk-00001.parquet").unlink()
    (tmp_path / "out" / ".chunk-00001.parquet.1-1.part").write_bytes(b"half")
    seen: list[tuple[int, int]] = []
    again = run_study(prepared(), tmp_path / "out", executor=HERE, on_run=lambda *at: seen.append(at))
    assert seen == [(10, 12), (12, 12)]
    assert again.ran == 2
    assert figures(again) == figures(whole)
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == figures(whole)
    assert not list((tmp_path / "out").glob(".*.part"))
    assert run_study(prepared(), tmp_path / "out", executor=HERE).ran == 0


def test_a_cut_part_is_run_again_with_a_warning(tmp_path: Path) -> None:
    whole = run_study(prepared(), tmp_path, executor=HERE)
    victim = tmp_path / "chunk-00002.parquet"
    victim.write_bytes(victim.read_bytes()[:100])
    with pytest.warns(DataWarning, match=r"chunk-00002\.parquet: .*; its runs are run again"):
        again = run_study(prepared(), tmp_path, executor=HERE)
    assert again.ran == 2
    assert figures(again) == figures(whole)


def test_studies_of_one_family_share_their_runs(tmp_path: Path) -> None:
    first = prepare_study(fakes.study(family="drawn"), Setup())
    run_study(first, tmp_path, executor=HERE)
    study = fakes.study(family="drawn")
    object.__setattr__(study, "name", "sums")
    assert run_study(prepare_study(study, Setup()), tmp_path, executor=HERE).ran == 0
    assert {path.name for path in tmp_path.glob("*.json")} == {"study.json", "draws.json", "sums.json"}


def test_a_folder_is_not_taken_by_mistake(tmp_path: Path) -> None:
    run_study(prepared(), tmp_path / "out", executor=HERE)
    for other in (prepared(seed=4), prepared(runs=4), prepared(chunk=3)):
        with pytest.raises(ConfigError, match=r"holds another study .*expected the same one or a new folder"):
            run_study(other, tmp_path / "out", executor=HERE)
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("x")
    with pytest.raises(ConfigError, match=r"holds no study\.json, expected the folder of a study"):
        run_study(prepared(), tmp_path / "letters", executor=HERE)
    with pytest.raises(ConfigError, match="is a file, expected a folder"):
        run_study(prepared(), tmp_path / "letters" / "dear.txt", executor=HERE)


def test_another_program_is_another_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_study(prepared(), tmp_path, executor=HERE)
    monkeypatch.setattr("terranav.experiment.studies.runner.program_checksum", lambda: "edited")
    with pytest.raises(ConfigError, match="holds another study"):
        run_study(prepared(), tmp_path, executor=HERE)


def test_failed_runs_are_counted_and_the_rest_goes_on(tmp_path: Path) -> None:
    result = run_study(prepared(fakes.run_brittle, runs=20), tmp_path, executor=HERE)
    assert 0 < result.failed < 20
    assert result.first_error == "ValueError: no luck"
    (table,) = result.report.tables
    assert table.rows == (("calm", "20"), ("wild", str(20 - result.failed)))
    assert run_study(prepared(fakes.run_brittle, runs=20), tmp_path, executor=HERE).ran == 0
    with pytest.raises(StateError, match="all 12 runs failed, the first with ValueError: never"):
        run_study(prepared(fakes.run_broken), tmp_path / "broken", executor=HERE)


def test_a_killed_worker_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(StateError, match="a worker process ended before it was done"):
        run_study(prepared(fakes.run_killed), tmp_path, executor=Processes(1))


def test_who_stops_reading_does_not_wait_for_what_is_under_way(tmp_path: Path) -> None:
    results = Processes(2).unordered(partial(fakes.nap, tmp_path), [0, 60, 61, 62])
    assert next(results) == (0, 0)
    results.close()  # type: ignore[attr-defined]
    assert [path.name for path in tmp_path.iterdir()] == ["0"]


def test_only_some_cases() -> None:
    assert [case.name for case in prepare_study(fakes.study(), Setup(only=("wil",))).plan.cases] == ["wild"]
    with pytest.raises(ConfigError, match="--only 'storm': no case of draws has such a name; cases: calm, wild"):
        prepare_study(fakes.study(), Setup(only=("storm",)))
    with pytest.raises(ConfigError, match="--runs is 1"):
        prepare_study(fakes.study(), Setup(), 1)
    with pytest.raises(ConfigError, match="--seed is -1"):
        prepare_study(fakes.study(), Setup(seed=-1))


KILLED = """
import sys
from pathlib import Path
from terranav.experiment.processes import Processes
from terranav.experiment.studies import runner
from terranav.experiment.studies.runner import prepare_study, run_study
from terranav.experiment.studies.study import Setup
from tests.experiment.studies import fakes
runner.program_checksum = lambda: "as it was"  # this is not about an edited program
if __name__ == "__main__":
    study = prepare_study(fakes.study(fakes.run_slow, chunk=1), Setup(seed=3), 10)
    run_study(study, Path(sys.argv[1]), executor=Processes(2), on_run=lambda *at: print(*at, flush=True))
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills a process")
def test_killed_and_resumed_the_figures_are_the_same_and_no_worker_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terranav.experiment.studies.runner.program_checksum", lambda: "as it was")
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    root = Path(__file__).resolve().parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    rng = random.Random(1)
    for _ in range(2):
        parent = subprocess.Popen(
            [sys.executable, str(script), str(tmp_path / "out")], stdout=subprocess.PIPE, env=environment, text=True
        )
        assert parent.stdout is not None
        lines = [parent.stdout.readline() for _ in range(3)]  # what was there, and two more runs
        assert all(lines)
        time.sleep(rng.uniform(0.0, 0.1))
        parent.kill()
        parent.wait()
        assert parent.stdout.read() is not None  # ends when the last process that holds it does: the workers are gone
    done = len(list((tmp_path / "out").glob("chunk-*.parquet")))
    assert 4 <= done < 20
    study = prepared(fakes.run_slow, runs=10, chunk=1)
    resumed = run_study(study, tmp_path / "out", executor=HERE)
    assert resumed.ran == 20 - done
    assert figures(resumed) == figures(run_study(study, tmp_path / "undisturbed", executor=HERE))
