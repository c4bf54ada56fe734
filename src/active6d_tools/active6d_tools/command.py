"""Entry point of the ``active6d`` command: what must happen before the slow imports."""

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command. Ctrl-C ends it with exit code 130 at any time, while it imports as well."""

    def stop(number: int, frame: FrameType | None) -> None:
        os.write(2, b"active6d: interrupted\n")
        os._exit(130)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    from active6d_core.interrupts import INTERRUPTED, INTERRUPTS
    from active6d_tools.cli import main as run

    INTERRUPTS.watch()
    try:
        run()
    except KeyboardInterrupt:
        INTERRUPTS.seen.set()
    except SystemExit as end:
        if not INTERRUPTS.seen.is_set():
            raise
        if end.code != INTERRUPTED:
            print("active6d: interrupted", file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    if INTERRUPTS.seen.is_set():
        os._exit(INTERRUPTED)  # libraries may wait for their threads when the interpreter ends
