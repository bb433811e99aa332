from __future__ import annotations

import os
import subprocess
import sys

import pytest

from terranav.core import memory
from terranav.core.errors import ConfigError

LIMITED = """
import resource
from terranav.core import memory
from terranav.core.errors import ConfigError
resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
memory.need(100 * 2**20, "little")
try:
    memory.need(2**30, "field of 11585 x 11585 cells")
except ConfigError as error:
    print(error)
"""


def test_the_least_limit_is_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_address_space", lambda: float("inf"))
    monkeypatch.setattr(memory, "_cgroup", lambda: 3e9)
    monkeypatch.setattr(memory, "_machine", lambda: 8e9)
    assert memory.available() == (3e9, "limit of the control group")
    memory.need(2.9e9, "fits")
    with pytest.raises(ConfigError, match=r"^viterbi: needs 2\.9 GiB of memory, but 2\.8 GiB is left \(limit of the"):
        memory.need(3.1e9, "viterbi")


def test_a_little_is_never_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_machine", lambda: 1.0)
    memory.need(memory.SMALL - 1, "a little")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="needs /proc and a limit on the address space")
def test_a_limit_on_the_address_space_counts_what_is_used() -> None:
    said = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, text=True, check=True).stdout
    assert said.startswith("field of 11585 x 11585 cells: needs 1.0 GiB of memory, but ")
    assert said.endswith("MiB is left (limit on the address space, ulimit -v)\n")


def test_what_cannot_be_read_sets_no_limit(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    from pathlib import Path

    assert isinstance(tmp_path, Path)
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    assert memory._cgroup() == float("inf")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("1000\n")
    assert memory._cgroup() == float("inf")
    (tmp_path / "memory.max").write_text("5000\n")
    (tmp_path / "memory.stat").write_text("anon 10\ninactive_file 600\n")
    assert memory._cgroup() == 4600.0
