"""The reliability battery: seeded attacks on messages, bags, views, files, graphs, processes and commands.

    python tests/battery --seconds 1200 --seed 0
    python tests/battery --attacks kills,interrupts --trials 100

Each row of the table is one kind of attack with the number of trials and of failures; exit code 1 if there are any.
"""

import os
import sys
from pathlib import Path

_TESTS = Path(__file__).parents[1]
_SOURCES = [str(path) for path in sorted((_TESTS.parent / "src").glob("active6d_*"))]
sys.path += [str(path) for path in (_TESTS, _TESTS / "core", _TESTS / "bringup") if str(path) not in sys.path]
# Child processes import the same sources.
os.environ["PYTHONPATH"] = os.pathsep.join([str(_TESTS), *_SOURCES, os.environ.get("PYTHONPATH", "")]).rstrip(
    os.pathsep
)
# Before the first import of rclpy, as in conftest.py.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

from active6d_core.ros.network import keep_on_this_machine  # noqa: E402

keep_on_this_machine()
