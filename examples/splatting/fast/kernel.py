"""The decorator of the numba kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, and keep the result on disk where that is possible.

    Without fastmath, so that infinities and NaNs behave as in the reference, and every sum has
    one order; a division by zero gives an infinity. The kernels release the GIL and use one
    thread.

    The cache knows only the source file of a kernel. So kernels call only kernels of their own
    file; when a constant or `lanes.py`, which they import, changes, delete `__pycache__`.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba finds no writable directory for its cache
        return numba.njit(**options)(function)
