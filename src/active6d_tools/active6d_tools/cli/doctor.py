"""``active6d doctor``."""

from dataclasses import asdict

import typer

from active6d_tools.cli.options import JsonFile
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages


def doctor(json_file: JsonFile = None) -> None:
    """Say what is installed, what is missing and how to mend it, and try the core path.

    Exit code 0 if everything that an episode needs is there and works.

    Example: [bold]active6d doctor --json doctor.json[/bold]
    """
    from rich.markup import escape
    from rich.table import Table

    from active6d_tools.doctor import examine, works

    checks = []
    with messages.status("looking") as status:
        for check in examine():
            checks.append(check)
            status.update(f"looking: {escape(check.name)}")
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(width=1)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    group = None
    for check in checks:
        if check.group != group:
            group = check.group
            table.add_row("", f"[bold]{group}[/bold]")
        mark = "[green]✓[/green]" if check.ok else "[red]✗[/red]" if check.needed else "[yellow]–[/yellow]"
        table.add_row(mark, escape(check.name), escape(check.detail))
        if check.mend:
            table.add_row("", "", f"[cyan]→ {escape(check.mend)}[/cyan]")
    console.print(table)
    ok = works(checks)
    write_json(json_file, {"ok": ok, "checks": [asdict(check) for check in checks]})
    missing = ", ".join(check.name for check in checks if check.needed and not check.ok)
    verdict = (
        f"[red]The core path does not work: {escape(missing)}.[/red]"
        if missing
        else "[green]The core path works.[/green]"
    )
    console.print(verdict)
    raise typer.Exit(0 if ok else 1)
