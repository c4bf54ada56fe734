"""How fast policies can be trained: steps of the environment a second, with the deployed fusion."""

import os
from pathlib import Path
from typing import Any

from active6d_agent.environment.throughput import measure_steps_per_second


def measure_environment(
    bank: Path, *, workers: int | None = None, environments: int = 512, seconds: float = 5.0, seed: int = 0
) -> dict[str, Any]:
    """Steps a second of random actions in episodes of five moves.

    Args:
        bank: path of a scene bank.
        workers: processes, one a core when None.
        environments: episodes side by side in each.
        seconds: to measure for.
        seed: of scenes, starts and actions.

    Returns:
        ``steps_per_second`` of all processes together, and how it was measured.
    """
    workers = workers or os.cpu_count() or 1
    rate = measure_steps_per_second(bank, workers=workers, environments=environments, seconds=seconds, seed=seed)
    return {"steps_per_second": rate, "workers": workers, "environments": environments, "seconds": seconds}
