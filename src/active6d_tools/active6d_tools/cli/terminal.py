"""The terminal: results on standard output, progress and notes on standard error."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, JustifyMethod
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

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


@contextmanager
def work_progress() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar that is set with a description, the number of steps done and the number of all steps."""
    with progress_bar() as bar:
        task = bar.add_task("starting", total=None)
        yield lambda what, done, total: bar.update(task, description=what, completed=done, total=total)


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], *, title: str | None = None, left: int = 1
) -> None:
    """Print a table without lines; without names of columns it has no header.

    Cells of the first ``left`` columns are plain text to the left. The other cells may have rich's markup and are to
    the right. Nothing is cut. Text is folded. Where the terminal is too narrow for the first column and for those to
    the right, lines are longer than it.
    """
    rows = [(*map(escape, row[:left]), *row[left:]) for row in rows]
    table = Table(
        box=None, pad_edge=False, title=title, title_justify="left", show_header=any(columns), collapse_padding=True
    )
    for number, column in enumerate(columns):
        justify: JustifyMethod = "left" if number < left else "right"
        whole = number == 0 or number >= left
        words = [*column.split(), *(row[number] for row in rows if number < len(row))]
        width = max((Text.from_markup(word).cell_len for word in words), default=None) if whole else None
        table.add_column(column, justify=justify, header_style="dim", min_width=width, overflow="fold")
    for row in rows:
        table.add_row(*row)
    least = sum((column.min_width or 0) + 1 for column in table.columns)
    console.print(table, width=max(console.width, least), crop=False)
