"""Attacks on files: recordings with damage, and hostile files."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from stub_episode import StubEpisode
from test_bag_reader import damage_of, write_bag

from battery.trials import Trial


def bags() -> Iterator[Trial]:
    """A bag that is cut anywhere, or has one flipped byte: what is missing is reported."""
    with TemporaryDirectory() as folder:
        whole = write_bag(Path(folder) / "bag", StubEpisode().messages())

        def trial(rng: np.random.Generator) -> str:
            damaged = Path(shutil.copytree(whole, Path(folder) / "copy" / "bag"))
            path = damaged / "bag.mcap"
            data = bytearray(path.read_bytes())
            position = int(rng.integers(len(data)))
            if cut := rng.random() < 0.5:
                data = data[:position]
            else:
                data[position] ^= int(rng.integers(1, 256))
            path.write_bytes(data)
            try:
                reported = damage_of(damaged)
            finally:
                shutil.rmtree(damaged.parent)
            return "" if reported else f"{'cut at' if cut else 'flip of'} byte {position} is not reported"

        yield trial


def files() -> Iterator[Trial]:
    """Hostile files: read or refused within twenty seconds, with less than 2 GB, and without a traceback."""
    command = [sys.executable, str(Path(__file__).with_name("hostile_files.py"))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdin is not None and reader.stdout is not None  # noqa: PT018
        reader.stdout.readline()

        def trial(rng: np.random.Generator) -> str:
            reader.stdin.write(f"{rng.integers(2**62)}\n")
            reader.stdin.flush()
            answer = reader.stdout.readline()
            return answer.strip() if answer else f"the reader itself ended with exit code {reader.wait()}"

        yield trial
        reader.stdin.close()
