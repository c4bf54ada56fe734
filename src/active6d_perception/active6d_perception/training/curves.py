"""Training curves as a picture."""

from collections.abc import Sequence
from pathlib import Path

_RATES = {
    "add_half": "e_ADD, half visible",
    "add_tenth": "e_ADD, a tenth visible",
    "adds_half": "ADD-S, half visible",
    "adds_tenth": "ADD-S, a tenth visible",
    "precision": "precision",
}


def draw_curves(history: Sequence[dict[str, float]], path: Path, title: str) -> None:
    """Draw rates found on the validation split, and the loss's terms (training solid, validation dashed), over steps.

    Args:
        history: one entry per validation, as in ``curves.json``.
        path: PNG to write.
        title: of the picture.
    """
    from matplotlib.figure import Figure  # slow to import, and a training that never validates needs none of it

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    rates, losses = figure.subplots(1, 2)
    steps = [entry["step"] for entry in history]
    for key, label in _RATES.items():
        rates.plot(steps, [entry[key] for entry in history], marker=".", label=label)
    rates.set(xlabel="step", ylabel="rate on the validation split", ylim=(0, 1))
    terms = [key.removeprefix("training_") for key in history[0] if key.startswith("training_")]
    for color, term in enumerate(terms):
        losses.plot(steps, [entry[f"training_{term}"] for entry in history], f"C{color}-", label=term)
        losses.plot(steps, [entry[f"loss_{term}"] for entry in history], f"C{color}--")
    losses.set(xlabel="step", ylabel="loss (dashed: validation)")
    for axes in (rates, losses):
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=100)
