"""Speed of the training environment with the deployed fusion, in steps per second."""

import os
from pathlib import Path
from typing import Any

from active6d_agent.environment.throughput import measure_steps_per_second


def measure_environment(
    bank: Path, *, workers: int | None = None, environments: int = 512, seconds: float = 5.0, seed: int = 0
) -> dict[str, Any]:
    """Steps per second of random actions in episodes of five moves.

    Args:
        bank: path of a scene bank.
        workers: number of processes; None for one per core.
        environments: number of parallel episodes in each process.
        seconds: duration of the measurement.
        seed: of scenes, starts and actions.

    Returns:
        ``steps_per_second`` of all processes together, and the settings of the measurement.
    """
    workers = workers or os.cpu_count() or 1
    rate = measure_steps_per_second(bank, workers=workers, environments=environments, seconds=seconds, seed=seed)
    return {"steps_per_second": rate, "workers": workers, "environments": environments, "seconds": seconds}
