"""pybullet with the output of its C code silenced: an import banner, a line per connection, and the log of V-HACD."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["BulletClient", "connect", "decompose", "pybullet", "silence"]
_LIBC = ctypes.CDLL(None)


@contextmanager
def silence(*streams: int) -> Iterator[None]:
    """Discard the output of C code to file descriptors: 1 is standard output, 2 is standard error."""
    _LIBC.fflush(None)
    saved = [os.dup(stream) for stream in streams]
    with open(os.devnull, "w") as null:
        for stream in streams:
            os.dup2(null.fileno(), stream)
    try:
        yield
    finally:
        _LIBC.fflush(None)
        for stream, copy in zip(streams, saved, strict=True):
            os.dup2(copy, stream)
            os.close(copy)


with silence(1, 2):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient


def connect() -> BulletClient:
    """Start a separate physics server in this process, without a window."""
    with silence(1):
        return BulletClient(connection_mode=pybullet.DIRECT)


def decompose(source: str, parts: str, log: str) -> None:
    """Write the convex parts (V-HACD) of the ``.obj`` file ``source`` to the file ``parts``, one group per part."""
    with silence(1):
        pybullet.vhacd(source, parts, log, resolution=400_000, concavity=0.001, maxNumVerticesPerCH=48)
