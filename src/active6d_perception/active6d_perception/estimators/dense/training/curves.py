"""Drawing of training curves."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from active6d_core.files import atomic_file

_RATES = {
    "add_half": "ADD, half visible",
    "add_tenth": "ADD, a tenth visible",
    "adds_half": "ADD-S, half visible",
    "adds_tenth": "ADD-S, a tenth visible",
    "precision": "precision",
}


def draw_curves(history: Sequence[dict[str, float]], path: Path, title: str) -> None:
    """Draw the rates on the validation split and the terms of the loss (training and validation) over the steps.

    Args:
        history: one entry per validation, as in ``curves.json``.
        path: PNG file to write.
        title: of the figure.
    """
    from matplotlib.figure import Figure  # slow to import, and not needed without a validation

    figure = Figure(figsize=(11, 7), layout="constrained")
    subfigures: Any = figure.subfigures(2, 1, height_ratios=(3, 4))
    above, below = subfigures
    rates = above.subplots()
    steps = [entry["step"] for entry in history]
    for key, label in _RATES.items():
        rates.plot(steps, [entry[key] for entry in history], marker=".", label=label)
    rates.set(ylabel="rate on the validation split", ylim=(0, 1))
    rates.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    rates.grid(alpha=0.3)
    # One panel per term, because their magnitudes differ by orders.
    terms = [key.removeprefix("training_") for key in history[0] if key.startswith("training_")]
    panels = below.subplots(2, -(-len(terms) // 2)).ravel()
    for unused in panels[len(terms) :]:
        unused.remove()
    for axes, term in zip(panels, terms, strict=False):
        axes.plot(steps, [entry[f"training_{term}"] for entry in history], marker=".")
        axes.plot(steps, [entry[f"loss_{term}"] for entry in history], marker=".", linestyle="--")
        axes.set_title(f"loss: {term}", fontsize="medium")
        axes.grid(alpha=0.3)
    below.supxlabel("step (losses: training solid, validation dashed)", fontsize="medium")
    figure.suptitle(title)
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, dpi=100)
