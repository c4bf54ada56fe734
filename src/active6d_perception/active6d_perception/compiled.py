"""How loops are compiled: those over points, each of which needs something else looked at.

Numbers come out as numpy's would, for no operation is reordered or fused. Functions take contiguous, writable arrays of
one type: others would be compiled for anew, while a view waits. Whoever makes an object that needs them calls them
once. No index is checked, so what is not a number must not become one.
"""

import numba

#: Decorates a function. Kept on disk; runs beside other threads; a division by zero is infinite, as in numpy.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
