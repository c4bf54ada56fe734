"""The commands whose results are in docs/results.md, and the generated parts of that page."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from active6d_tools.results import tables
from active6d_tools.results.goals import CLAIMS, DEFAULT, GOALS, PAPERS, Measured, goals_table

OBJECTS = ("coffee_cup", "bunny", "mug")
_REPORTS, _FIGURES = "docs/results", "docs/img"


@dataclass(frozen=True)
class Job:
    """One command, run for each object.

    Attributes:
        name: of the job; part of the names of its files.
        command: arguments of ``active6d``, without object and files.
        draws: whether it draws a figure.
        trains: whether it trains, or needs a bank of more scenes, which takes hours.
        times: whether it measures times, and must run alone on the machine.
    """

    name: str
    command: str
    draws: bool = False
    trains: bool = False
    times: bool = False

    def report(self, object_name: str) -> str:
        """The JSON file."""
        return f"{_REPORTS}/{self.name}_{object_name}.json"

    def figure(self, object_name: str) -> str:
        """The PNG file, if it draws one."""
        return f"{_FIGURES}/results_{self.name}_{object_name}.png"

    def arguments(self, object_name: str) -> list[str]:
        """Arguments of ``active6d``; paths are relative to the repository."""
        drawn = ["--png", self.figure(object_name)] if self.draws else []
        return [*self.command.split(), "--object", object_name, "--json", self.report(object_name), *drawn]

    def is_done(self, root: Path, object_name: str) -> bool:
        """Whether its files exist."""
        files = [self.report(object_name), *([self.figure(object_name)] if self.draws else [])]
        return all((root / file).is_file() for file in files)


#: Key of a report by which it is known whether its figure exists.
_DRAWN = "is_drawn"

_MANY = f"single-view,random,max-distance,unidirectional,entropy,lowest-score,information-gain,{PAPERS},{DEFAULT}"
JOBS = {
    job.name: job
    for job in (
        Job("evaluate", "evaluate --policies all --steps 5"),
        Job("evaluate_thirty", f"evaluate --policies {_MANY} --steps 5 --sample 1200 --banks banks", trains=True),
        Job("evaluate_wild", f"evaluate --policies {_MANY} --steps 5 --split wild_test --banks banks", trains=True),
        Job("evaluate_three", f"evaluate --policies random,{DEFAULT} --steps 3"),
        Job("evaluate_four", f"evaluate --policies random,{DEFAULT} --steps 4"),
        Job("evaluate_ten", "evaluate --policies random --steps 10"),
        Job(
            "steps",
            f"ablate steps --policies random,max-distance,unidirectional,lowest-score,{DEFAULT} --sample 100",
            draws=True,
        ),
        Job("planning", "ablate planning --sample 200", draws=True),
        Job(
            "noise-resampling",
            f"ablate noise-resampling --policies unidirectional,{DEFAULT} --sample 1000",
            draws=True,
        ),
        Job("fusion-methods", "benchmark fusion --split test --episodes 4"),
        Job("varied-shapes", "benchmark fusion --split test --episodes 4 --vary-shapes"),
        Job("camera-errors", "benchmark camera-errors --split test", draws=True),
        Job("fusion", "ablate fusion --policies random --sample 1000"),
        Job("verification", "ablate verification --policies random --sample 1000"),
        Job("alpha", "ablate alpha --sample 1000", draws=True, trains=True),
        Job("attention", "ablate attention --sample 1000", trains=True),
        Job("signs", "ablate signs --sample 1000", trains=True),
        Job("seeds", "ablate seeds --sample 1000", trains=True),
        Job("paper", "ablate paper --seeds 1 --sample 1000", trains=True),
        Job("arm", "benchmark arm --episodes 20", draws=True),
        Job("environment", "benchmark environment", times=True),
        Job("pipeline", "benchmark pipeline", draws=True, times=True),
    )
}


def read_reports(root: Path) -> Mapping[str, Measured]:
    """Results by object and job, of those jobs that have been run.

    Raises:
        ValueError: a file is damaged; the message names it.
    """
    measured: dict[str, dict[str, dict[str, Any]]] = {}
    for name in OBJECTS:
        measured[name] = {}
        for job in JOBS.values():
            path = root / job.report(name)
            if path.is_file():
                try:
                    report = json.loads(path.read_text())
                except ValueError as error:
                    raise ValueError(f"{path}: damaged result ({error}); delete it and measure it again") from error
                measured[name][job.name] = {**report, _DRAWN: (root / job.figure(name)).is_file()}
    return measured


def fill(page: str, measured: Mapping[str, Measured]) -> str:
    """Generate every block of a page between ``<!-- results: NAME -->`` and ``<!-- end -->`` again.

    Raises:
        ValueError: an unknown block.
    """

    def renew(match: re.Match[str]) -> str:
        if match[2] not in BLOCKS:
            raise ValueError(f"docs/results.md has a block '{match[2]}'; known are {', '.join(BLOCKS)}")
        return f"{match[1]}\n{BLOCKS[match[2]](measured)}\n{match[3]}"

    return re.sub(r"(<!-- results: ([\w -]+) -->)\n.*?(<!-- end -->)", renew, page, flags=re.DOTALL)


def _of_job(name: str, measured: Mapping[str, Measured]) -> dict[str, dict[str, Any]]:
    return {object_name: own[name] for object_name, own in measured.items() if name in own}


def _command(name: str) -> str:
    return f"    active6d {' '.join(JOBS[name].arguments('NAME'))}"


def _block(name: str, make: Callable[[tables.Reports], str]) -> Callable[[Mapping[str, Measured]], str]:
    """The command, then a table of its results."""

    def render(measured: Mapping[str, Measured]) -> str:
        reports = _of_job(name, measured)
        parts = [_command(name), make(reports) if reports else "Not measured yet."]
        if JOBS[name].draws:
            drawn = [each for each, report in reports.items() if report.get(_DRAWN, True)]
            parts += [f"![{name}, {each}](img/{Path(JOBS[name].figure(each)).name})" for each in drawn]
        return "\n\n".join(parts)

    return render


def _each(make: Callable[[dict[str, Any]], str]) -> Callable[[tables.Reports], str]:
    """One table per object, under its name."""

    def render(reports: tables.Reports) -> str:
        return "\n\n".join(
            f"**{name}**, {report['episodes']} episodes in {report['scenes']} scenes\n\n{make(report)}"
            for name, report in reports.items()
        )

    return render


def _differences(job: str, name: str) -> Callable[[Mapping[str, Measured]], str]:
    """The policy ``name`` minus every other one, of each object."""

    def render(report: dict[str, Any]) -> str:
        return tables.differences_table(report, name) if name in report["policies"] else "Not measured yet."

    return lambda measured: _each(render)(_of_job(job, measured))


def _variants(*keys: str) -> Callable[[tables.Reports], str]:
    return lambda reports: tables.variants_table(reports, keys)


_PAPERS_MEASURES = ("detection_rate", "e_add_mm", "distance_m")
_FUSED = ("detection_rate", "e_add_mm", "detection_rate_at_n", "reported")
BLOCKS: dict[str, Callable[[Mapping[str, Measured]], str]] = {
    "goals": lambda measured: goals_table(GOALS, measured),
    "claims": lambda measured: goals_table(CLAIMS, measured, "reproduced"),
    "evaluate": _block("evaluate", _each(tables.policies_table)),
    "default differences": _differences("evaluate", DEFAULT),
    "paper differences": _differences("evaluate", PAPERS),
    "evaluate thirty": _block("evaluate_thirty", _each(tables.policies_table)),
    "thirty differences": _differences("evaluate_thirty", DEFAULT),
    "evaluate wild": _block("evaluate_wild", _each(tables.policies_table)),
    "wild differences": _differences("evaluate_wild", DEFAULT),
    "evaluate three": _block("evaluate_three", _each(tables.policies_table)),
    "evaluate four": _block("evaluate_four", _each(tables.policies_table)),
    "evaluate ten": _block("evaluate_ten", _each(tables.policies_table)),
    "steps": _block("steps", tables.steps_tables),
    "planning": _block("planning", _variants("detection_rate", "e_add_mm", "distance_m", "moves")),
    "noise-resampling": _block("noise-resampling", tables.noise_resampling_table),
    "fusion-methods": _block("fusion-methods", tables.fusion_methods_table),
    "varied-shapes": _block("varied-shapes", tables.fusion_methods_table),
    "camera-errors": _block("camera-errors", tables.camera_errors_table),
    "fusion": _block("fusion", _variants(*_FUSED)),
    "verification": _block("verification", _variants(*_FUSED)),
    "alpha": _block("alpha", _variants(*_PAPERS_MEASURES)),
    "attention": _block("attention", _variants(*_PAPERS_MEASURES)),
    "signs": _block("signs", _variants(*_PAPERS_MEASURES)),
    "seeds": _block("seeds", tables.seeds_table),
    "paper": _block("paper", tables.seeds_table),
    "arm": _block("arm", tables.arm_table),
    "environment": _block("environment", tables.environment_table),
    "pipeline": _block("pipeline", tables.pipeline_table),
}
