"""The one decorator of all kernels: compiled, cached on disk where that is possible, free of the GIL."""

from __future__ import annotations

import numba


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
        return numba.njit(cache=True, **told)(function)
    except RuntimeError:  # numba: "no locator available", neither the package nor the user cache can be written
        return numba.njit(**told)(function)
