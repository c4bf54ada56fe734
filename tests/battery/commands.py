"""Attacks on commands: Ctrl-C at random times, small limits of the system, and file systems that are full."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
from rosbags.rosbag2 import Reader
from stub_episode import StubEpisode
from synthetic_bank import synthetic_bank
from test_bag_reader import damage_of, write_bag

from active6d_agent.bank.scene_bank import bank_path
from battery.trials import Trial

#: Seconds in which Ctrl-C ends a command, and the same of an episode whose nodes are processes.
LATEST_END, LATEST_END_OF_PROCESSES = 2.0, 5.0
#: Seconds after which a command that cannot work counts as one that hangs.
LONGEST = 120.0
STUBS = ("--import", "stub_graph", "--estimator", "stub")
EPISODE = ("episode", *STUBS, "--policy", "random")
TRAINING = ("episodes=2", "updates=2", "starts=5", "batch=8", "longest=3", "evaluate_every=1")
_MARK = "ACTIVE6D_BATTERY_TRIAL"


@dataclass
class Command:
    """One run of ``active6d``, and what it left."""

    process: subprocess.Popen[str]
    mark: str
    output: Path

    def wait(self, seconds: float) -> int | None:
        """The exit code, None if it has not ended by then; it is killed."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            self.process.kill()
            self.process.wait()

    def text(self) -> str:
        """What it said on standard error."""
        return self.output.read_text(errors="replace")

    def left(self) -> list[str]:
        """Its processes that are alive two seconds after its end; they are killed."""
        ours = [each for each in psutil.process_iter() if _environment(each).get(_MARK) == self.mark]
        alive = psutil.wait_procs(ours, timeout=2.0)[1]
        names = [" ".join(each.cmdline())[:80] for each in alive]
        for each in alive:
            each.kill()
        return names


def _environment(process: psutil.Process) -> dict[str, str]:
    try:
        return process.environ()
    except psutil.Error:
        return {}


def start(folder: Path, arguments: tuple[str, ...], limit: tuple[int, int] | None = None) -> Command:
    """Start ``active6d`` with its home in a folder; ``limit`` is a resource and its number."""
    mark = uuid.uuid4().hex
    home = {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "MPLCONFIGDIR": str(folder / "cache")}
    command = [sys.executable, "-m", "active6d_tools", *arguments]
    if limit is not None and limit[0] == resource.RLIMIT_NPROC:
        command = [*_UNPRIVILEGED, *command]

    def restrict() -> None:
        if limit is not None:
            resource.setrlimit(limit[0], (limit[1], limit[1]))

    output = folder / "output.txt"
    with output.open("w") as file:
        process = subprocess.Popen(
            command,
            env={**os.environ, **home, _MARK: mark},
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=file,
            text=True,
            preexec_fn=restrict,
        )
    return Command(process, mark, output)


#: Another user, for the limit of processes does not count for root. It may still read the project.
_UNPRIVILEGED = (
    *("setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"),
    *("--inh-caps=-all,+dac_read_search", "--ambient-caps=-all,+dac_read_search"),
    "--bounding-set=-all,+dac_read_search",
)


@contextmanager
def _folder() -> Iterator[Path]:
    """A folder that any user may write to."""
    with TemporaryDirectory() as name:
        os.chmod(name, 0o777)
        yield Path(name)


def _long_commands(banks: Path, folder: Path) -> dict[str, tuple[str, ...]]:
    """Commands that run for many seconds, each writing into the folder."""
    return {
        "episode": (*EPISODE, "--steps", "90", "--bag", str(folder / "bag")),
        "processes": (*EPISODE, "--steps", "90", "--bag", str(folder / "bag"), "--processes"),
        "bank": ("bank", *STUBS, "--split", "val", "--workers", "2", "--banks", str(folder / "banks")),
        "policy": ("train", "policy", "--banks", str(banks), "--out", str(folder / "policy")),
        "paper": ("train", "policy", "--policy", "attention", "--banks", str(banks), "--out", str(folder / "policy")),
        "scenes": ("scenes", "generate", "--split", "val", "--workers", "2", "--into", str(folder / "scenes")),
    }


def _short_commands(banks: Path, bag: Path, folder: Path) -> dict[str, tuple[str, ...]]:
    """Commands that end by themselves, each writing into the folder."""
    sets = [part for one in TRAINING for part in ("--set", f"training.{one}")]
    train = ("train", "policy", "--steps", "2", "--length", "1", *sets)
    return {
        "episode": (*EPISODE, "--steps", "3", "--bag", str(folder / "bag")),
        "processes": (*EPISODE, "--steps", "3", "--bag", str(folder / "bag"), "--processes"),
        "report": ("report", str(bag), "--output", str(folder / "report.html")),
        "policy": (*train, "--banks", str(banks), "--out", str(folder / "policy")),
        "bank": ("bank", *STUBS, "--split", "val", "--scenes", "1", "--workers", "1", "--banks", str(folder / "banks")),
        "scenes": ("scenes", "report", "--split", "val", "--json", str(folder / "scenes.json")),
    }


def _make_banks(folder: Path) -> Path:
    made = synthetic_bank("mug", scenes=2, objects=6)
    for split in ("train", "val"):
        made.save(bank_path(folder, "mug", split))
    return folder


def interrupts() -> Iterator[Trial]:
    """Ctrl-C at a random time: exit code 130 in time, nobody left behind, no traceback, the bag closed."""
    with TemporaryDirectory() as shared:
        banks = _make_banks(Path(shared))

        def trial(rng: np.random.Generator) -> str:
            with _folder() as folder:
                commands = _long_commands(banks, folder)
                kind, delay = str(rng.choice(list(commands))), float(rng.uniform(0.0, 12.0))
                command = start(folder, commands[kind])
                _wait_for_handler(command.process)
                time.sleep(delay)
                if command.process.poll() == 0:
                    return ""  # an episode that came to its end
                command.process.send_signal(signal.SIGINT)
                struck = time.monotonic()
                code = command.wait(30.0)
                seconds, left = time.monotonic() - struck, command.left()
                latest = LATEST_END_OF_PROCESSES if kind == "processes" else LATEST_END
                wrong = [f"exit code {code}"] * (code != 130)
                wrong += [f"{seconds:.1f} s"] * (seconds > latest)
                wrong += [f"left: {each}" for each in left]
                wrong += [f"said {command.text()}"] * ("Traceback" in command.text())
                if (folder / "bag").exists():
                    wrong += _not_closed(folder / "bag")
                return f"{kind} after {delay:.2f} s: {'; '.join(wrong)}" if wrong else ""

        yield trial


def _not_closed(bag: Path) -> list[str]:
    """What is wrong with a bag that must be whole, whether it holds a view or not yet."""
    if not (bag / "metadata.yaml").is_file():
        return ["the bag is not closed"]
    with Reader(bag) as reader:
        return ["messages are missing"] * (sum(1 for _ in reader.messages()) != reader.message_count)


def _wait_for_handler(process: subprocess.Popen[str]) -> None:
    """Return when the command has set its handlers, which it does before its slow imports."""
    while process.poll() is None:
        with suppress(OSError):
            status = Path(f"/proc/{process.pid}/status").read_text()
            caught = int(next(line for line in status.splitlines() if line.startswith("SigCgt")).split()[1], 16)
            if caught >> (signal.SIGTERM - 1) & 1:
                return


def _fault(command: Command, what: str) -> str:
    """What is wrong with the end of a command that may have failed."""
    code = command.wait(LONGEST)
    left, said = command.left(), command.text().strip()
    last = said.splitlines()[-1] if said else ""
    wrong = ["it hangs"] * (code is None) + [f"left: {each}" for each in left]
    wrong += [f"exit code {code}"] * (code is not None and code not in (0, 1, 2))
    wrong += ["a traceback"] * ("Traceback" in said)
    wrong += ["no line that says why"] * (code not in (0, None) and not last.startswith("active6d: "))
    return f"{what}: {', '.join(wrong)}; {said[-2000:]}" if wrong else ""


def limits() -> Iterator[Trial]:
    """Few open files, little memory, few processes: a command works, or ends with one line that says why."""
    kinds: dict[str, Callable[[np.random.Generator], tuple[int, int]]] = {
        "open files": lambda rng: (resource.RLIMIT_NOFILE, int(rng.integers(4, 200))),
        "bytes of memory": lambda rng: (resource.RLIMIT_AS, int(1e9 * rng.uniform(0.05, 6.0))),
    }
    if os.getuid() == 0 and shutil.which("setpriv"):
        kinds["processes"] = lambda rng: (resource.RLIMIT_NPROC, int(rng.integers(1, 60)))
    with TemporaryDirectory() as shared:
        banks = _make_banks(Path(shared))
        bag = write_bag(Path(shared) / "bag", StubEpisode().messages())

        def trial(rng: np.random.Generator) -> str:
            with _folder() as folder:
                commands = _short_commands(banks, bag, folder)
                name, kind = str(rng.choice(list(commands))), str(rng.choice(list(kinds)))
                limit = kinds[kind](rng)
                return _fault(start(folder, commands[name], limit), f"{name} with {limit[1]} {kind}")

        yield trial


def disks() -> Iterator[Trial]:
    """A file system that is full: an episode goes on without its bag, everything else ends with one line."""
    with TemporaryDirectory() as shared:
        banks = _make_banks(Path(shared))
        bag = write_bag(Path(shared) / "bag", StubEpisode().messages())

        def trial(rng: np.random.Generator) -> str:
            kilobytes = int(rng.choice([0, 1, 10, 100, 1000]) + rng.integers(1, 200))
            with _folder() as folder, _small_disk(folder / "disk", kilobytes) as (disk, limit):
                commands = _short_commands(banks, bag, disk)
                name = str(rng.choice(list(commands)))
                command = start(folder, commands[name], limit)
                what = f"{name} with {kilobytes} kB"
                fault, said = _fault(command, what), " ".join(command.text().split())
                code = command.process.returncode
                if not fault and code != 0 and str(disk) not in said.replace(" ", ""):
                    fault = f"{what}: {said} does not name the folder"
                if not fault and name == "episode" and code != 0 and (disk / "bag").exists():
                    fault = f"{what}: the episode did not go on: {said}"
                if not fault and (disk / "bag").exists():
                    damage_of(disk / "bag")
                return fault

        yield trial


@contextmanager
def _small_disk(folder: Path, kilobytes: int) -> Iterator[tuple[Path, tuple[int, int] | None]]:
    """A folder with so much space; where nothing can be mounted, a limit of the size of any file in its place."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "battery", str(folder)]
    if subprocess.run(mount, stderr=subprocess.DEVNULL).returncode != 0:
        yield folder, (resource.RLIMIT_FSIZE, 1000 * kilobytes)
        return
    try:
        yield folder, None
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
