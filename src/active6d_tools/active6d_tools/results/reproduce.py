#!/usr/bin/env python3
"""Measure every table and figure of docs/results.md and write them to that page."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated

import typer

from active6d_core.files import write_file
from active6d_tools.cli.terminal import messages, progress_bar
from active6d_tools.results.page import JOBS, OBJECTS, Job, fill, read_reports

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs/results.md"
app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)


def run(job: Job, object_name: str) -> None:
    """Run one command in the repository.

    Raises:
        RuntimeError: it failed; the message is the end of its output.
    """
    # Small networks gain nothing from threads, and several commands run at the same time.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "active6d_tools", *job.arguments(object_name)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError("\n".join(done.stderr.strip().splitlines()[-3:]))


def run_all(jobs: list[tuple[Job, str]], workers: int) -> list[str]:
    """Run commands in parallel; one line for each failure."""
    failures: list[str] = []
    if not jobs:
        return failures
    with ThreadPoolExecutor(workers) as pool, progress_bar() as bar:
        running = {pool.submit(run, job, name): f"{job.name}, {name}" for job, name in jobs}
        task = bar.add_task(f"measuring {', '.join(dict.fromkeys(job.name for job, _ in jobs))}", total=len(jobs))
        for done in as_completed(running):
            bar.update(task, advance=1)
            if error := done.exception():
                failures.append(f"{running[done]}: {error}")
                bar.console.print(failures[-1], highlight=False, markup=False)
    return failures


@app.command()
def main(
    only: Annotated[str, typer.Option(help=f"Names of jobs, separated by commas: {', '.join(JOBS)}.")] = ",".join(JOBS),
    objects: Annotated[str, typer.Option(help="Objects separated by commas.")] = ",".join(OBJECTS),
    trainings: Annotated[bool, typer.Option(help="Also run jobs that train policies; this takes hours.")] = (False),
    again: Annotated[bool, typer.Option("--again", help="Measure again what has been measured.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Number of parallel commands; times are measured alone.")] = (
        os.cpu_count() or 1
    ),
) -> None:
    """Run the missing measurements of docs/results.md and generate its tables.

    Example: [bold]python -m active6d_tools.results.reproduce --only steps,planning --objects mug --again[/bold]
    """
    names = [name.strip() for name in only.split(",")]
    if unknown := set(names) - set(JOBS):
        raise typer.BadParameter(f"no '{min(unknown)}' among {', '.join(JOBS)}", param_hint="--only")
    wanted = [
        (JOBS[name], object_name.strip())
        for name in names
        for object_name in objects.split(",")
        if (trainings or not JOBS[name].trains) and (again or not JOBS[name].is_done(ROOT, object_name.strip()))
    ]
    failures = run_all([pair for pair in wanted if not (pair[0].trains or pair[0].times)], workers)
    # One training job after the other, because ablations share trainings; objects in parallel.
    for job in (job for job in JOBS.values() if job.trains):
        failures += run_all([pair for pair in wanted if pair[0] is job], workers)
    failures += run_all([pair for pair in wanted if pair[0].times], 1)
    write_file(PAGE, fill(PAGE.read_text(), read_reports(ROOT)))
    messages.print(f"{len(wanted) - len(failures)} measured, {len(failures)} failed; wrote {PAGE}", highlight=False)
    raise typer.Exit(bool(failures))


if __name__ == "__main__":
    app()
