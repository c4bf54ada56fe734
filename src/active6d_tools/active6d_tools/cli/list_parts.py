"""``active6d list``: the estimators, policies and sensors that can be chosen by name."""

from active6d_tools.cli.options import Imports, JsonFile
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import console


def list_parts(imports: Imports = None, json_file: JsonFile = None) -> None:
    """List all estimators, policies and sensors with their origin: built in, a package with its version, or a module.

    Packages add them by entry points of the groups active6d.estimators, active6d.policies and
    active6d.sensors, modules by --import or
    the environment variable ACTIVE6D_IMPORT.

    Example: [bold]active6d list --import my.module[/bold]
    """
    from rich.markup import escape
    from rich.table import Table

    from active6d_agent.policies.registry import policy_origins
    from active6d_perception.estimators.registry import estimator_origins
    from active6d_sim.rendering.sensor_registry import sensor_origins

    found = {"estimator": estimator_origins(), "policy": policy_origins(), "sensor": sensor_origins()}
    table = Table(box=None, pad_edge=False)
    for column in ("kind", "name", "origin"):
        table.add_column(column, header_style="dim", no_wrap=True)
    for kind, origins in found.items():
        for name, origin in sorted(origins.items()):
            table.add_row(kind, escape(name), escape(origin))
    console.print(table)
    write_json(json_file, found)
