"""Result tables: exact round trips, and foreign or cut files refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from terranav.core.errors import DataError
from terranav.io.results import read_result_table, write_result_table


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    values=arrays(np.float64, st.integers(0, 8)),
    facts=st.dictionaries(st.text(st.characters(exclude_categories=["Cs"]), max_size=5), st.binary(), max_size=3),
)
def test_round_trip_is_exact(tmp_path: Path, values: np.ndarray, facts: dict[str, bytes]) -> None:
    path = tmp_path / "result.parquet"
    words = np.array([f"é{i}" for i in range(values.size)], dtype=np.str_)
    write_result_table(path, {"a": values, "status": words}, facts)
    columns, metadata = read_result_table(path)
    assert np.array_equal(columns["a"], values, equal_nan=True)
    assert np.array_equal(np.signbit(columns["a"]), np.signbit(values))
    assert columns["status"].dtype.kind == "U"
    assert columns["status"].tolist() == words.tolist()
    assert metadata == facts


def test_text_metadata_is_utf8_and_integers_become_floats(tmp_path: Path) -> None:
    write_result_table(tmp_path / "r.parquet", {"n": np.arange(3)}, {"é": "ü"})
    columns, metadata = read_result_table(tmp_path / "r.parquet")
    assert metadata == {"é": "ü".encode()}
    assert columns["n"].dtype == np.float64
    assert [file.name for file in tmp_path.iterdir()] == ["r.parquet"]


def test_files_that_are_no_result(tmp_path: Path) -> None:
    path = tmp_path / "r.parquet"

    def refused(message: str) -> None:
        with pytest.raises(DataError, match=message) as caught:
            read_result_table(path)
        assert "\n" not in str(caught.value)

    refused(r"r.parquet: no such file, expected a saved result \(.parquet\)")
    path.write_bytes(b"")
    refused("the file is empty")
    write_result_table(path, {"a": np.arange(100.0)}, {})
    path.write_bytes(path.read_bytes()[:-30])
    refused("is not a readable Parquet file")
    pq.write_table(pa.table({"a": [1.0]}), path)
    refused("has no metadata terranav.table = 1, expected a saved result")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"a": np.zeros(2), "b": np.zeros(3)}, r"column b has shape \(3,\), expected \(2,\) like the others"),
        ({"a": np.zeros((2, 2))}, r"column a has shape \(2, 2\), expected \(2,\)"),
        ({"a": np.array([None, 1])}, "column a is of type object, expected numbers or texts"),
    ],
)
def test_arrays_that_cannot_be_stored(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        write_result_table(tmp_path / "r.parquet", columns, {})
    assert not list(tmp_path.iterdir())
