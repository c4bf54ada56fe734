"""The terminal: results on standard output, progress and notes on standard error."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

#: Results only.
console = Console()
#: Progress and notes.
messages = Console(stderr=True)


def progress_bar() -> Progress:
    """A progress bar on standard error with a description, counts, elapsed time and time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        console=messages,
    )
