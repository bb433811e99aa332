"""The one decorator of all kernels: compiled, cached on disk where that is possible, free of the GIL."""

from __future__ import annotations

import numba


def jit(function):
    """Compile a module-level kernel with numba; without a writable cache folder it is compiled anew each process."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # numba: "no locator available", neither the package nor the user cache can be written
        return numba.njit(nogil=True, error_model="numpy")(function)
