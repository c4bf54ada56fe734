"""Compilation of loops over points that NumPy cannot express well.

Results are those of NumPy, because no operation is reordered or fused. Compiled functions take contiguous, writable
arrays of one type; other types would be compiled again while a view is processed. Objects that use such functions call
them once when they are created. Indices are not checked, so NaN must not become an index.
"""

import numba

#: Decorator. Compiled code is cached on disk and releases the GIL; a division by zero gives infinity, as in NumPy.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
