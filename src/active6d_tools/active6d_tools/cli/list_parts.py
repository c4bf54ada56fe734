"""``active6d list``: the estimators, policies and sensors that can be chosen by name."""

from active6d_tools.cli.options import Imports, JsonFile
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import messages, print_table


def list_parts(imports: Imports = None, json_file: JsonFile = None) -> None:
    """List all estimators, policies and sensors with their origin: built in, a package with its version, or a module.

    Packages add them by entry points of the groups active6d.estimators, active6d.policies and
    active6d.sensors, modules by --import or
    the environment variable ACTIVE6D_IMPORT.

    Example: [bold]active6d list --import my.module[/bold]
    """
    from active6d_agent.policies.registry import policy_origins
    from active6d_core.registry import leave_out_broken_imports
    from active6d_perception.estimators.registry import estimator_origins
    from active6d_sim.rendering.sensor_registry import sensor_origins

    left_out, found = leave_out_broken_imports(), {}
    for kind, origins in (("estimator", estimator_origins), ("policy", policy_origins), ("sensor", sensor_origins)):
        try:
            found[kind] = origins()
        except ValueError as error:  # two packages have parts of one name
            left_out.append(str(error))
    rows = [(kind, *part) for kind, parts in found.items() for part in sorted(parts.items())]
    print_table(("kind", "name", "origin"), rows, left=3)
    for reason in left_out:
        messages.print(f"left out: {reason}", highlight=False, markup=False)
    write_json(json_file, found)
