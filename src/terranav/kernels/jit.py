"""The one decorator of all kernels: compiled, cached on disk where that is possible, free of the GIL."""

from __future__ import annotations

from functools import partial

import numba


def jit(function=None, **options):
    """Compile a module-level kernel with numba; without a writable cache folder it is compiled anew each process.

    As `@jit(...)` it takes numba's options too: `forceinline=True` for a function that is too long to be laid open in
    its caller's loop unasked, without which that loop stays off the vector registers.
    """
    if function is None:
        return partial(jit, **options)
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    except RuntimeError:  # numba: "no locator available", neither the package nor the user cache can be written
        return numba.njit(nogil=True, error_model="numpy", **options)(function)
