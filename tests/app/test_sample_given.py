from __future__ import annotations

from pathlib import Path

import pytest

import terranav as tn
from terranav.app.given import open_maps
from terranav.core.errors import ConfigError


def test_the_word_sample_is_the_embedded_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (chart,) = open_maps([Path("sample")], {"sigma": None})
    assert chart.checksum == tn.sample_map().checksum
    with pytest.raises(ConfigError, match="--map-sigma is given for the embedded map 'sample'"):
        open_maps([Path("sample")], {"sigma": [2.0]})


def test_a_file_of_that_name_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sample").write_text("no raster")
    with pytest.raises(tn.DataError, match="sample"):
        open_maps([Path("sample")], {})
