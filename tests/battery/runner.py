"""Repeats attacks, for a time or a number of trials each, and prints their table."""

import argparse
import sys
import time
import traceback
from typing import Any

import numpy as np

from battery import __doc__ as description
from battery import bags_and_files, commands, graphs, inputs
from battery.trials import Attack, Verdict

ATTACKS: dict[str, Attack] = {
    "stamps": inputs.stamps,
    "messages": inputs.messages,
    "wire": inputs.wire,
    "views": inputs.views,
    "bags": bags_and_files.bags,
    "files": bags_and_files.files,
    "episodes": graphs.episodes,
    "resets": graphs.resets,
    "pairs": graphs.pairs,
    "kills": graphs.kills,
    "composed": graphs.composed,
    "interrupts": commands.interrupts,
    "limits": commands.limits,
    "disks": commands.disks,
}
#: A trial of these may take more than half a minute on busy cores.
SLOW = {"kills", "interrupts", "limits", "disks"}


def run(
    attack: Attack, seconds: float, seed: int, most: int | None = None, on_trial: Any = lambda trials, failures: None
) -> tuple[int, list[str], str]:
    """Repeat one kind of attack.

    Args:
        attack: what is repeated.
        seconds: no trial begins later, unless ``most`` is given.
        seed: of the trials.
        most: number of trials in place of a time.
        on_trial: called before each trial with the number of trials and what failed so far.

    Returns:
        the number of trials, what failed, and what the attack says of all trials.
    """
    failures: list[str] = []
    trials = 0
    source = attack()
    trial, deadline = next(source), time.monotonic() + seconds
    while trials < most if most is not None else time.monotonic() < deadline:
        on_trial(trials, failures)
        try:
            failure = trial(np.random.default_rng([seed, trials]))
        except Exception:
            failure = traceback.format_exc().strip().replace("\n", " | ")
        if failure:
            failures.append(f"trial {trials}: {failure}")
        trials += 1
    verdict = next(source, Verdict(""))
    source.close()
    return trials, failures + [verdict.failure] * bool(verdict.failure), verdict.note


def main() -> int:
    """Run the attacks and print the table."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all attacks together")
    parser.add_argument("--trials", type=int, help="of each attack, in place of a time")
    parser.add_argument("--attacks", metavar="NAME,NAME", default=",".join(ATTACKS), help="by default all: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    options = parser.parse_args()
    names = options.attacks.split(",")
    if unknown := [name for name in names if name not in ATTACKS]:
        parser.error(f"--attacks {unknown[0]}: there are {', '.join(ATTACKS)}")
    print("| attack | trials | failures | seconds a trial | |\n|---|---|---|---|---|")
    failed: list[str] = []
    for name in names:
        progress, began = _Progress(name), time.monotonic()
        share = options.seconds / len(names)
        trials, failures, note = run(ATTACKS[name], share, options.seed, options.trials, progress.show)
        each = (time.monotonic() - began) / max(trials, 1)
        failed += [f"{name}, {failure}" for failure in failures]
        progress.clear()
        print(f"| {name} | {trials} | {len(failures)} | {each:.2g} | {note} |", flush=True)
    print(*failed, sep="\n")
    return bool(failed)


class _Progress:
    """What has failed as soon as it has, and one line for a person who watches a terminal, some times a second."""

    def __init__(self, name: str) -> None:
        self._name, self._began, self._next, self._told = name, time.monotonic(), 0.0, 0

    def show(self, trials: int, failures: list[str]) -> None:
        """Say where the attack is."""
        for failure in failures[self._told :]:
            self.clear()
            print(f"{self._name}, {failure}", file=sys.stderr, flush=True)
        self._told = len(failures)
        if sys.stderr.isatty() and time.monotonic() > self._next:
            seconds = time.monotonic() - self._began
            text = f"{self._name}: {trials} trials, {self._told} failures, {seconds:.0f} s"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
            self._next = time.monotonic() + 0.2

    def clear(self) -> None:
        """Leave no line behind."""
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
