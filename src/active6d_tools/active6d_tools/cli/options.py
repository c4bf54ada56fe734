"""Options that several subcommands have, and how their texts are read."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.terminal import messages

if TYPE_CHECKING:
    from active6d_agent.bank.scene_bank import SceneBank
    from active6d_core.object_model import ObjectModel

JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results to this JSON file.")]
Seed = Annotated[int, typer.Option(help="Seed of the random generators.", min=0)]
ObjectName = Annotated[str, typer.Option("--object", help="Name of the object, see `active6d object list`.")]
BagFolder = Annotated[
    Path, typer.Argument(metavar="BAG", help="Folder of a recorded bag, or a file: .mcap, .db3 or .bag (ROS 1).")
]
BagTopics = Annotated[
    str,
    typer.Option(
        "--topics",
        metavar="KEY=NAME,...",
        help="Topics of another program's camera: color, depth, info, depth_info, pose; and the frame world.",
    ),
]
BagDepthScale = Annotated[
    float, typer.Option("--depth-scale", min=0.0, help="Metres per unit of its depth; by default as REP-118 says.")
]
BagRectified = Annotated[
    bool | None,
    typer.Option(
        "--rectified/--raw",
        help="Whether its images are rectified already; by default if rect is a word of the colour topic's name.",
    ),
]
BagObject = Annotated[str | None, typer.Option("--object", help="Name of the object, if the bag does not contain it.")]
Processes = Annotated[bool, typer.Option("--processes", help="Run every node in its own process.")]
ParamsFile = Annotated[Path | None, typer.Option(metavar="FILE", help="YAML file with ROS parameters of the nodes.")]
NodeParameters = Annotated[
    list[str] | None, typer.Option("--set", metavar="NODE.NAME=VALUE", help="Set a parameter of a node; repeatable.")
]
PolicyParameters = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="POLICY.NAME=VALUE", help="Set a parameter of a policy; repeatable."),
]
Split = Annotated[str, typer.Option(help="Split of the scenes: train, val, test, wild_val or wild_test.")]
SensorName = Annotated[
    str, typer.Option("--sensor", help="Sensor model: auto (active_stereo, in wild scenes random), {sensors}.")
]
Banks = Annotated[
    Path | None,
    typer.Option("--banks", metavar="DIR", help="Folder of the banks; by default active6d/banks in the cache folder."),
]
Sample = Annotated[
    int | None, typer.Option(min=1, help="Number of starts, sampled with --seed; by default all of them.")
]


def _import_modules(modules: list[str] | None) -> list[str]:
    if modules:
        from active6d_core.registry import import_extensions, request_imports

        request_imports(modules)
        import_extensions()
    return modules or []


#: Takes effect when the command line is read; the commands need not look at it.
Imports = Annotated[
    list[str] | None,
    typer.Option(
        "--import",
        metavar="MODULE",
        callback=_import_modules,
        help="Import a Python module that registers estimators, policies or sensors; repeatable.",
    ),
]

#: In the order of the table that ``active6d evaluate`` prints.
ALL_POLICIES = (
    *("single-view", "random", "max-distance", "unidirectional", "entropy", "lowest-score", "information-gain"),
    *("attention", "view-attention", "oracle", "all-views"),
)

#: Policies that ``active6d train policy`` trains.
LEARNED = ("view-attention", "attention")
#: The paper's policy, trained with the paper's length and learning rate.
PAPER = "attention-paper"


def parse_overrides(texts: list[str]) -> dict[str, dict[str, Any]]:
    """``node.parameter=value`` texts to node, parameter and value, which is read as YAML as in ROS.

    Raises:
        ValueError: a text that is not of that form.
    """
    from active6d_core.structured_text import parse_yaml

    overrides: dict[str, dict[str, Any]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        node, dot, parameter = name.partition(".")
        if not (equals and dot and node and parameter):
            raise ValueError(f"--set {text}: expected NODE.NAME=VALUE, such as hypothesis_fusion.epsilon=0.01")
        try:
            overrides.setdefault(node, {})[parameter] = parse_yaml(value)
        except ValueError as error:
            raise ValueError(f"--set {text}: the value is {error}") from error
        if overrides[node][parameter] is None:
            raise ValueError(f"--set {text}: the value is empty; an empty text is {name}='\"\"'")
    return overrides


def recorded_policies(text: str, model: "ObjectModel", parameters: dict[str, dict[str, Any]]) -> list[str]:
    """Policies for recorded scenes out of a comma-separated list; ``all`` leaves out those without weights.

    Raises:
        ValueError: an unknown name, a wrong parameter, or a bound, which needs a bank.
    """
    from active6d_agent.evaluation.policy_evaluation import BOUNDS
    from active6d_agent.policies.registry import create_policy
    from active6d_core.view_sphere import ViewSphere

    names = [name.strip() for name in (",".join(ALL_POLICIES[: -len(BOUNDS)]) if text == "all" else text).split(",")]
    usable = []
    for name in names:
        if name in BOUNDS:
            raise ValueError(f"--policies '{name}' is a bound of scene banks, not for recorded scenes")
        own = {"entropy": [0.0] * len(ViewSphere())} if name == "entropy" else {}
        try:
            create_policy(name, model, **{**own, **parameters.get(name, {})})
        except ValueError as error:
            if text != "all":
                raise
            messages.print(f"left out: {error}", highlight=False, markup=False)
            continue
        usable.append(name)
    return usable


def usable_policies(text: str, bank: "SceneBank", parameters: dict[str, dict[str, Any]]) -> list[str]:
    """Names out of a comma-separated list; ``all`` leaves out, with a note, policies whose weights are missing.

    Raises:
        ValueError: an unknown name, a wrong parameter, or a policy asked for by name that has no weights.
    """
    from active6d_agent.evaluation.policy_evaluation import BOUNDS
    from active6d_agent.policies.registry import create_policy, policy_origins
    from active6d_core.registry import BUILT_IN

    names = [name.strip() for name in text.split(",")]
    if text == "all":
        added = [name for name, origin in policy_origins().items() if origin != BUILT_IN]
        names = [*ALL_POLICIES[: -len(BOUNDS)], *sorted(added), *BOUNDS]
    usable = []
    for name in names:
        try:
            if name not in BOUNDS:
                own = {"entropy": bank.scenes[0].entropy} if name == "entropy" else {}
                create_policy(name, bank.model, **{**own, **parameters.get(name, {})})
        except ValueError as error:
            if text != "all" or name in parameters:
                raise
            messages.print(f"left out: {error}", highlight=False, markup=False)
            continue
        usable.append(name)
    unknown = sorted(parameters.keys() - set(usable))
    if unknown:
        raise ValueError(f"--set {unknown[0]}: no such policy among {', '.join(usable)}")
    return usable
