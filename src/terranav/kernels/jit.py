"""The one decorator of all kernels: compiled, cached on disk where that is possible, free of the GIL."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import numba


def _sources():
    """Digest of all kernels' sources: a compiled kernel holds what it calls, in whatever module that is."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


_SOURCES = _sources()


def jit(function=None, *, fastmath=False, forceinline=False):
    """Compile a module-level kernel with numba; without a writable cache folder it is compiled anew each process.

    Parameters
    ----------
    function : callable
    fastmath : bool or set of str
        Freedoms of the compiler, with a reason beside it: {"contract", "reassoc"} lets it take a sum in several lanes
        (the same ones each time); NaN and infinity keep their meaning.
    forceinline : bool
        For a function too long to be laid open in its caller's loop unasked, which would keep that loop off the vector
        registers.
    """
    if function is None:
        return lambda one: jit(one, fastmath=fastmath, forceinline=forceinline)
    told = {"nogil": True, "error_model": "numpy", "fastmath": fastmath, "forceinline": forceinline}
    try:
        compiled = numba.njit(cache=True, **told)(function)
    except RuntimeError:  # numba: "no locator available", neither the package nor the user cache can be written
        return numba.njit(**told)(function)
    with contextlib.suppress(AttributeError):  # not compiled, or not kept; numba looks at the kernel's own file alone
        kept = compiled._cache._cache_file
        kept._source_stamp = (kept._source_stamp, _SOURCES)
    return compiled
