from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from terranav.kernels import jit

CALLER = """
from terranav.kernels.callee import told
from terranav.kernels.jit import jit

@jit
def twice():
    return 2 * told()
"""
CALLEE = """
from terranav.kernels.jit import jit

@jit
def told():
    return {value}
"""


def test_a_kernel_is_compiled_anew_when_what_it_calls_has_changed(tmp_path: Path) -> None:
    """numba itself looks at the time of the caller's file alone."""
    package = tmp_path / "terranav"
    (package / "kernels").mkdir(parents=True)
    for folder in (package, package / "kernels"):
        (folder / "__init__.py").touch()
    shutil.copy(Path(jit.__file__), package / "kernels" / "jit.py")
    (package / "kernels" / "caller.py").write_text(CALLER)

    def answer(value: int) -> str:
        (package / "kernels" / "callee.py").write_text(CALLEE.format(value=value))
        script = "from terranav.kernels.caller import twice; print(twice(), len(twice.stats.cache_hits))"
        done = subprocess.run(
            [sys.executable, "-B", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert [answer(21), answer(21), answer(35)] == ["42 0", "42 1", "70 0"]
