"""An end within seconds of Ctrl-C or SIGTERM, whatever the process is doing, and pools of processes that end too."""

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context
from pathlib import Path
from types import FrameType
from typing import cast

#: Exit code of what a Ctrl-C has ended.
INTERRUPTED = 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG = 1
# Functions that C code calls without a look at their exceptions. Numba's compiled code calls the first for every array
# that it returns, and crashes. LLVM calls the others while it compiles, and the exception is lost.
_UNINTERRUPTIBLE = {"_numba_unpickle", "_raw_object_cache_notify", "_raw_object_cache_getbuffer"}
_RETRY_SECONDS = 0.01


class Interrupts:
    """Watches the signals of a command from a thread of its own, and ends the process when it does not end itself.

    Python runs a signal's handler only between two steps of the main thread, and an exception that it raises can be
    lost in a library. The thread sees the signal at once and waits ``grace`` seconds. Then it calls what was
    registered with :meth:`before_end`, kills the child processes and ends the process with exit code 130.

    Attributes:
        grace: seconds that the command has to end.
        seen: set as soon as a signal has come.
    """

    def __init__(self) -> None:
        self.grace = 1.0
        self.seen = threading.Event()
        self._last: list[Callable[[], None]] = []
        self._postponed: int | None = None

    def watch(self) -> None:
        """Start watching; call it once, in the main thread."""
        read, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in _SIGNALS:
            signal.signal(number, self._raise)
        threading.Thread(target=self._wait, args=(read,), daemon=True).start()

    @contextmanager
    def before_end(self, action: Callable[[], None]) -> Iterator[None]:
        """Call ``action`` from the thread if the process is ended within the block."""
        self._last.append(action)
        try:
            yield
        finally:
            self._last.remove(action)

    def _raise(self, number: int, frame: FrameType | None) -> None:
        # The thread may come too late to say so: the exception can be caught and the process at its end before.
        self.seen.set()
        while frame is not None:
            if frame.f_code.co_name in _UNINTERRUPTIBLE:
                self._postponed = number
                return
            frame = frame.f_back
        raise KeyboardInterrupt

    def _wait(self, read: int) -> None:
        while not set(os.read(read, 64)) & set(_SIGNALS):
            pass
        self.seen.set()
        # Not the main thread's end, but the process's is awaited: this thread is a daemon and ends with it.
        end = time.monotonic() + self.grace
        while (left := end - time.monotonic()) > 0:
            threading.Event().wait(min(left, _RETRY_SECONDS))
            number, self._postponed = self._postponed, None
            if number is not None:
                signal.pthread_kill(cast(int, threading.main_thread().ident), number)
        for action in reversed(self._last):
            with suppress(Exception):
                action()
        for child in _children(os.getpid()):
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        with suppress(OSError):
            os.write(sys.stderr.fileno(), b"active6d: interrupted\n")
        os._exit(INTERRUPTED)


#: The process's only instance.
INTERRUPTS = Interrupts()


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with this one, however it ends, and at once when the block is left by an exception.

    They are spawned: a forked child inherits locks of threads that do not exist in it (Embree, BLAS).

    Raises:
        ChildProcessError: one of them was killed.
    """
    before = set(active_children())
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_follow, initargs=(os.getpid(),))
    try:
        yield pool
    except BaseException as error:
        for process in set(active_children()) - before:
            process.kill()
        # Waits for the pool's own thread only. An interpreter that ends beside it may show a traceback.
        pool.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            cause = "a worker process was killed, most likely because memory ran out; use fewer --workers"
            raise ChildProcessError(cause) from error
        raise
    pool.shutdown()


def _follow(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end when it does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(INTERRUPTED)


def _children(process: int) -> list[int]:
    """Ids of all processes below one, from the proc file system; none where there is no such thing."""
    found: list[int] = []
    for path in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, path.read_text().split()):
                found += [*_children(child), child]
    return found
