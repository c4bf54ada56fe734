"""``active6d doctor``."""

from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from active6d_tools.cli.options import JsonFile
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console, messages

if TYPE_CHECKING:
    from active6d_tools.machine_doctor import Check


def doctor(
    graph: Annotated[bool, typer.Option("--graph", help="Examine a running graph instead of this machine.")] = False,
    domain: Annotated[
        int | None, typer.Option(min=0, max=232, help="ROS domain of the graph; by default ROS_DOMAIN_ID or 0.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="Namespace of the graph.")] = "",
    seconds: Annotated[float, typer.Option(min=1.0, help="How long to listen to the graph.")] = 6.0,
    json_file: JsonFile = None,
) -> None:
    """Report what is installed, what is missing and how to fix it, and try the core path.

    With --graph: listen to a running graph and report silent topics, incompatible QoS and which node waits for what.
    Exit code 0 if everything that an episode needs is there and works.

    Example: [bold]active6d doctor --json doctor.json[/bold] or [bold]active6d doctor --graph --domain 7[/bold]
    """
    from active6d_tools.machine_doctor import examine, works

    if not graph and (domain is not None or namespace):
        raise ValueError("--domain and --namespace need --graph")
    if graph:
        from active6d_tools.graph_doctor import examine_graph, verdict

        checks, subject = _collect(examine_graph(domain, namespace, seconds)), "graph"
        well = verdict(checks)
    else:
        checks, subject, well = _collect(examine()), "core path", "The core path works."
    _print(checks)
    ok = works(checks)
    write_json(json_file, {"ok": ok, "checks": [asdict(check) for check in checks]})
    _print_verdict(checks, subject, well)
    raise typer.Exit(0 if ok else 1)


def _collect(found: "Iterable[Check]") -> "list[Check]":
    checks = []
    with messages.status("looking") as status:
        for check in found:
            checks.append(check)
            status.update(f"looking: {escape(check.name)}")
    return checks


def _print(checks: "list[Check]") -> None:
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
        if check.fix:
            table.add_row("", "", f"[cyan]→ {escape(check.fix)}[/cyan]")
    console.print(table)


def _print_verdict(checks: "list[Check]", subject: str, well: str) -> None:
    missing = ", ".join(check.name for check in checks if check.needed and not check.ok)
    if missing:
        console.print(f"[red]The {subject} does not work: {escape(missing)}.[/red]")
    else:
        console.print(escape(well), style="green" if well.startswith(f"The {subject} works") else "yellow")
