"""Entry point of the ``active6d`` command: what must happen before the slow imports."""

import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType

_WORD = b"active6d: interrupted\n"
#: What the middleware, ray casting and torch start at most on a machine with few cores.
_THREADS = 32


def main() -> None:
    """Run the command. Ctrl-C ends it with exit code 130 at any time, while it imports or closes as well."""
    _end_at_once()
    _refuse_few_threads()
    from active6d_core.interrupts import INTERRUPTED, INTERRUPTS

    code: object = INTERRUPTED
    try:
        from active6d_tools.cli import main as run

        INTERRUPTS.watch()
        try:
            run()
        finally:
            _end_at_once()
    except KeyboardInterrupt:
        code = None
    except SystemExit as end:
        code = end.code
        if code != INTERRUPTED and not INTERRUPTS.seen.is_set():
            raise
    with suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
        if code != INTERRUPTED:  # nothing has said so yet
            os.write(2, _WORD)
    # Libraries may wait for their threads when the interpreter ends. An interpreter that saw a KeyboardInterrupt within
    # exec() ends itself with SIGINT, even if the exception was caught.
    os._exit(INTERRUPTED)


def _refuse_few_threads() -> None:
    """End with one line where the system lets this user start few threads: libraries would end the process without."""
    done, started = threading.Event(), 0
    try:
        for started in range(_THREADS):  # noqa: B007
            threading.Thread(target=done.wait, daemon=True).start()
    except RuntimeError:
        with suppress(OSError):
            os.write(2, b"active6d: only %d threads can be started, %d are needed; " % (started, _THREADS))
            os.write(2, b"raise the limit of processes (ulimit -u), or end other programs\n")
        os._exit(1)
    finally:
        done.set()


def _end_at_once() -> None:
    def end(number: int, frame: FrameType | None) -> None:
        with suppress(OSError):
            os.write(2, _WORD)
        os._exit(130)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
