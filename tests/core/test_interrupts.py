"""Ctrl-C ends a command within seconds whatever it does, with exit code 130, and leaves no process behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time

import psutil
import pytest

from active6d_core.interrupts import worker_pool

# A handler that does nothing stands for a library that swallows the exception.
DEAF = """
import signal, time
from active6d_core.interrupts import INTERRUPTS
INTERRUPTS.grace = 0.3
INTERRUPTS.watch()
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *arguments: None)
with INTERRUPTS.before_end(lambda: print("closed", flush=True)):
    print("ready", flush=True)
    while True:
        time.sleep(0.01)
"""
POOL = """
import sys, time
from active6d_core.interrupts import INTERRUPTS, worker_pool
if __name__ == "__main__":
    INTERRUPTS.grace = 0.3
    INTERRUPTS.watch()
    with worker_pool(2) as pool:
        jobs = [pool.submit(time.sleep, 100) for _ in range(4)]
        while not all(job.running() for job in jobs[:2]):
            time.sleep(0.01)
        print("ready", flush=True)
        jobs[0].result()
"""
# Nearly all of its time goes into what compiled code does with the arrays that it returns.
COMPILED = """
import numba, numpy as np
from active6d_core.interrupts import INTERRUPTS
INTERRUPTS.watch()
@numba.njit
def many():
    a = np.empty(1)
    return a, a.copy(), a.copy(), a.copy(), a.copy(), a.copy(), a.copy(), a.copy()
many()
print("ready", flush=True)
while True:
    many()
"""


def start(script, *arguments):
    process = subprocess.Popen([sys.executable, *arguments, script], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_does_not_end_is_ended(number):
    process = start(DEAF, "-c")
    process.send_signal(number)
    began = time.monotonic()
    assert process.wait(10) == 130
    assert time.monotonic() - began < 2
    assert process.stdout.read() == "closed\n"


def test_compiled_code_does_not_crash():
    for _ in range(3):
        with start(COMPILED, "-c") as process:
            process.send_signal(signal.SIGINT)
            # A KeyboardInterrupt that nobody catches ends an interpreter by SIGINT; on a busy machine, the thread does.
            assert process.wait(10) in (-signal.SIGINT, 130), "-11 is a crash"


# A signal that comes while LLVM calls Python back.
CALLED_BACK = """
import signal, time
from active6d_core.interrupts import INTERRUPTS
INTERRUPTS.watch()
def _raw_object_cache_notify():
    signal.raise_signal(signal.SIGINT)
    return "went on"
print("ready", flush=True)
print(_raw_object_cache_notify(), flush=True)
try:
    time.sleep(0.5)
except KeyboardInterrupt:
    print("interrupted later", flush=True)
"""


def test_a_call_back_from_c_is_not_interrupted():
    with start(CALLED_BACK, "-c") as process:
        assert process.stdout.read() == "went on\ninterrupted later\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_pool_ends_with_its_command(tmp_path, number):
    (tmp_path / "pool.py").write_text(POOL)
    process = start(str(tmp_path / "pool.py"))
    workers = [child for child in psutil.Process(process.pid).children(recursive=True)]
    assert len(workers) >= 2
    process.send_signal(number)
    process.wait(10)
    busy = [worker for worker in workers if "spawn_main" in " ".join(cmdline(worker))]
    assert not psutil.wait_procs(busy, timeout=5)[1]


def cmdline(process):
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


@pytest.mark.parametrize("delay", [0.15, 0.6])
def test_ctrl_c_at_any_time_of_the_start_is_exit_code_130(delay):
    command = [sys.executable, "-m", "active6d_tools", "episode", "--object", "mug", "--scene", "mug/test/0"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while "command" not in modules(process.pid):
        assert process.poll() is None
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    assert process.wait(20) == 130
    assert time.monotonic() - began < 3
    assert "Traceback" not in process.stderr.read()


# What a library does that catches the exception: the interpreter remembers that exec() was left by it.
CAUGHT = """
def run():
    try:
        exec("os.kill(os.getpid(), signal.SIGINT)")
    except KeyboardInterrupt:
        sys.exit(1)
"""
CLOSING = """
def run():
    atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))
    sys.exit(0)
"""


@pytest.mark.parametrize("run", [CAUGHT, CLOSING], ids=["caught", "closing"])
def test_ctrl_c_that_a_library_catches_or_that_comes_at_the_end_is_exit_code_130(run):
    script = f"import atexit, os, signal, sys\nfrom active6d_tools import cli, command\n{run}"
    script += "cli.main = run\ncommand.main()"
    ended = subprocess.run([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True)
    assert (ended.returncode, ended.stderr) == (130, "active6d: interrupted\n")


def test_few_threads_are_one_line_before_a_library_needs_them():
    few = "import threading\nbegin, count = threading.Thread.start, iter(range(9))\ndef start(thread):\n    "
    few += "if next(count) == 7:\n        raise RuntimeError\n    begin(thread)\nthreading.Thread.start = start\n"
    script = few + "from active6d_tools import command\ncommand.main()"
    ended = subprocess.run([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True)
    words = "active6d: only 7 threads can be started, 32 are needed; raise the limit of processes (ulimit -u), or end"
    assert (ended.returncode, ended.stderr) == (1, f"{words} other programs\n")


def test_few_open_files_are_one_line_before_a_command_begins():
    few = "import resource, sys\nfrom active6d_tools import command\n"
    few += "resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))\nsys.argv = ['active6d', 'list']\ncommand.main()"
    ended = subprocess.run([sys.executable, "-c", few], stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 1
    assert ended.stderr.startswith("active6d: cannot start: [Errno 24] Too many open files")
    assert ended.stderr.endswith("; raise the limit (ulimit -n)\n")
    assert ended.stderr.count("\n") == 1


def modules(process):
    """A word that says that the command's own handler is in place: it ignores neither signal by default."""
    with open(f"/proc/{process}/status") as file:
        caught = int(next(line for line in file if line.startswith("SigCgt")).split()[1], 16)
    return "command" if caught >> (signal.SIGTERM - 1) & 1 else ""


def test_a_killed_worker_is_one_line_with_its_probable_cause():
    with pytest.raises(ChildProcessError, match="most likely because memory ran out"), worker_pool(1) as pool:
        pool.submit(os.kill, pool.submit(os.getpid).result(), signal.SIGKILL).result()


def test_nothing_of_a_pool_is_left_after_an_exception():
    before = set(threading.enumerate())
    with pytest.raises(KeyError):
        fail_beside_busy_workers()
    assert set(threading.enumerate()) == before
    assert not multiprocessing.active_children()


def fail_beside_busy_workers():
    with worker_pool(2) as pool:
        jobs = [pool.submit(time.sleep, 100) for _ in range(4)]
        while not jobs[0].running():
            time.sleep(0.01)
        raise KeyError
