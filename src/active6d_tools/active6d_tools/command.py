"""Entry point of the ``active6d`` command: what must happen before the slow imports."""

import errno
import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import NoReturn

_WORD = b"active6d: interrupted\n"
#: What the middleware, ray casting and torch start at most on a machine with few cores.
_THREADS = 32


def main() -> None:
    """Run the command. Ctrl-C ends it with exit code 130 at any time, while it imports or closes as well."""
    _end_at_once()
    _refuse_few_threads()
    try:
        _run()
    except OSError as error:  # a command reports its own; this is one before it began
        if os.environ.get("ACTIVE6D_TRACEBACK") or "--debug" in sys.argv:
            raise
        _refuse(f"cannot start: {error}" + "; raise the limit (ulimit -n)" * (error.errno == errno.EMFILE))


def _run() -> None:
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
        few = f"only {started} threads can be started, {_THREADS} are needed"
        _refuse(f"{few}; raise the limit of processes (ulimit -u), or end other programs")
    finally:
        done.set()


def _refuse(text: str) -> NoReturn:
    with suppress(OSError):
        os.write(2, f"active6d: {text}\n".encode())
    os._exit(1)


def _end_at_once() -> None:
    def end(number: int, frame: FrameType | None) -> None:
        with suppress(OSError):
            os.write(2, _WORD)
        os._exit(130)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
