"""What an attack is made of."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

#: One trial, of a random generator; what failed, in words, or nothing.
Trial = Callable[[np.random.Generator], str]


@dataclass(frozen=True)
class Verdict:
    """What an attack says of all its trials together: a note for the table, and what failed, if anything."""

    note: str
    failure: str = ""


#: Yields its trial, and a verdict at the end if it has one; between the two, the trial is repeated.
Attack = Callable[[], Iterator[Trial | Verdict]]


@dataclass
class Level:
    """Whether the memory of a process is level: the slope of its size over trials, after the first ones.

    Attributes:
        warm_up: number of trials that do not count.
        least: number of trials after those, below which nothing is judged.
    """

    warm_up: int = 20
    least: int = 100
    _megabytes: list[float] = field(default_factory=list)

    def add(self, megabytes: float) -> None:
        """The size after one more trial."""
        self._megabytes.append(megabytes)

    def slope(self) -> tuple[float, float]:
        """Kilobytes per trial with the half width of the 95 % interval, of a line through the means of ten blocks.

        Sizes that follow each other are alike, so a line through all of them would seem more certain than it is.
        """
        sizes = np.array(self._megabytes[self.warm_up :])
        length = len(sizes) // _BLOCKS
        means = sizes[len(sizes) - length * _BLOCKS :].reshape(_BLOCKS, length).mean(axis=1)
        at = length * (np.arange(_BLOCKS) - (_BLOCKS - 1) / 2)
        slope = at @ means / (at @ at)
        left = means - means.mean() - slope * at
        error = np.sqrt(left @ left / (_BLOCKS - 2) / (at @ at))
        return 1000 * float(slope), 1000 * _QUANTILE * float(error)

    def verdict(self) -> Verdict:
        """The slope in words; a failure if it is above :data:`LEVEL` with 95 % confidence."""
        count = len(self._megabytes) - self.warm_up
        if count < self.least:
            return Verdict(f"memory: not judged before {self.warm_up + self.least} trials")
        slope, half = self.slope()
        first, last = self._megabytes[self.warm_up], self._megabytes[-1]
        note = f"memory: {slope:+.1f} kB per trial (95 %: {slope - half:+.1f} to {slope + half:+.1f})"
        note += f", {first:.0f} to {last:.0f} MB over {count} trials"
        return Verdict(note, note if slope - half > LEVEL else "")


#: Kilobytes per trial; the system gives memory in pages of 4 kB.
LEVEL = 1.0
#: Blocks of a fit, and the quantile of Student's distribution for its interval with two degrees of freedom less.
_BLOCKS, _QUANTILE = 10, 2.306
