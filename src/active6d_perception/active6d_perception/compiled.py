"""Compilation of loops over points that NumPy cannot express well.

Results are those of NumPy, because no operation is reordered or fused. Compiled functions take contiguous, writable
arrays of one type; other types would be compiled again while a view is processed. Objects that use such functions call
them once when they are created. Indices are not checked, so NaN must not become an index.
"""

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Any:
    """Decorator. The code is cached on disk and releases the GIL; a division by zero gives infinity, as in NumPy."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        # Neither the folder of the source nor the user's can be written. It is compiled in every process then.
        return numba.njit(nogil=True, error_model="numpy")(function)
