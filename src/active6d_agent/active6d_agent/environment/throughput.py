"""How fast the environment is: steps per second of random actions with the deployed fusion."""

import time
from pathlib import Path

import numpy as np

from active6d_agent.environment.gym_environment import Active6DVectorEnv, make_spaces
from active6d_core.interrupts import worker_pool


def measure_steps_per_second(
    bank: Path, *, workers: int = 2, environments: int = 512, seconds: float = 5.0, steps: int = 5, seed: int = 0
) -> float:
    """Steps per second of ``workers`` processes together, each with its own episodes side by side.

    Loading the bank and projecting its hypotheses into all views are not counted.

    Args:
        bank: path of a scene bank.
        workers: processes.
        environments: episodes of each.
        seconds: to measure for.
        steps: moves T of an episode.
        seed: of scenes, starts and actions.
    """
    with worker_pool(workers) as pool:
        runs = [pool.submit(_run, bank, environments, seconds, steps, seed + worker) for worker in range(workers)]
        return float(sum(run.result() for run in runs))


def _run(bank: Path, environments: int, seconds: float, steps: int, seed: int) -> float:
    env, rng = Active6DVectorEnv(bank, environments, steps=steps), np.random.default_rng(seed)
    env.reset(seed=seed)
    actions = make_spaces(steps)[1]
    env.episodes.lookup.project_everything()
    moves, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < seconds:
        env.step(rng.uniform(actions.low, actions.high, (environments, 3)))
        moves += environments
    return moves / elapsed
