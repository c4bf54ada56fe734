"""pybullet with the output of its C code silenced: an import banner, a line per connection, and the log of V-HACD."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["BulletClient", "connect", "decompose", "pybullet", "silence"]
_DECOMPOSE = (
    "import pybullet, sys; pybullet.vhacd(*sys.argv[1:], resolution=400_000, concavity=0.001, maxNumVerticesPerCH=48)"
)
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
    """Write the convex parts (V-HACD) of the ``.obj`` file ``source`` to the file ``parts``, one group per part.

    In a process of its own: the library keeps Python's lock for seconds, and Ctrl-C would wait for it.

    Raises:
        OSError: the parts were not made.
    """
    command = [sys.executable, "-c", _DECOMPOSE, source, parts, log]
    ended = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if ended.returncode != 0 or not Path(parts).is_file():  # the library does not say what it could not write
        said = " ".join(ended.stderr.splitlines()[-1:])
        raise OSError(f"{parts} was not made from {source} (exit code {ended.returncode}) {said}".strip())
