"""Progress of work that several subcommands do."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from active6d_tools.cli.terminal import console, progress_bar

if TYPE_CHECKING:
    from active6d_agent.bank.scene_lookup import SceneLookup
    from active6d_tools.policy_training import PolicyTraining


def follow_training(training: "PolicyTraining", lookups: Sequence["SceneLookup"], title: str) -> None:
    """Train on look-ups of the train and val banks; show the progress and redraw the curve."""
    from active6d_tools.report.training_curves import draw_training

    with progress_bar() as bar:
        task = bar.add_task(title, total=training.total)
        for progress in training.start(*lookups):
            done = getattr(progress, "round", None) or progress.steps
            found = f"finds {progress.detection_rate:.3f}, ADD {progress.e_add_mm:.2f} mm, {progress.distance_m:.2f} m"
            bar.update(task, completed=done, description=f"{title}: {found}")
            draw_training(training.folder / "curve.png", title, training.curve())
    console.print(f"best weights: {training.best}", highlight=False, markup=False)


def collect_rows(rows: Iterable[dict[str, Any]], total: int, title: str) -> list[dict[str, Any]]:
    """The rows of an ablation; a row with a ``budget`` of moves counts as that much work."""
    collected = []
    with progress_bar() as bar:
        task = bar.add_task(title, total=total)
        for row in rows:
            collected.append(row)
            bar.update(task, advance=row.get("budget", 1), description=row["variant"])
    return collected
