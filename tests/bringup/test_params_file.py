"""What a parameter file gives a node is what ROS gives it, and what an episode takes from it."""

import pytest
import yaml
from rclpy.context import Context
from rclpy.node import Node
from ros_harness import fresh_domain

from active6d_agent.nodes.attention_policy import AttentionPolicyNode
from active6d_bringup.graph.episode import EpisodeSettings, ResolvedSettings, describe, resolve
from active6d_bringup.graph.params_file import default_params_file, parameters_of, read_params_file, unused_sections

NODE = "camera_simulator"


@pytest.fixture
def write(tmp_path):
    """Writes sections, name to parameters, in their order; gives the path."""

    def write_file(sections):
        path = tmp_path / "params.yaml"
        content = {name: {"ros__parameters": own} for name, own in sections.items()}
        path.write_text(yaml.safe_dump(content, sort_keys=False))
        return path

    return write_file


def of_ros(path, namespace):
    """The parameters that rclpy gives the node."""
    context = Context()
    context.init(args=["--ros-args", "--params-file", str(path)], domain_id=fresh_domain())
    options = {"start_parameter_services": False, "enable_rosout": False, "use_global_arguments": True}
    node = Node(
        NODE,
        context=context,
        namespace=namespace,
        automatically_declare_parameters_from_overrides=True,
        **options,
    )
    names = ("object", "seed")
    found = {name: node.get_parameter(name).value for name in names if node.has_parameter(name)}
    node.destroy_node()
    context.try_shutdown()
    return found


@pytest.mark.parametrize("namespace", ["", "cell", "hall/cell"])
@pytest.mark.parametrize(
    "names",
    [
        (NODE, "/**"),
        ("/**", NODE),
        (f"/**/{NODE}", f"/{NODE}"),
        (f"/cell/{NODE}", "/*"),
        (f"/*/{NODE}", f"cell/{NODE}"),
        (f"/hall/**/{NODE}", "/*/*"),
        (f"/hall/cell/{NODE}", f"/**/{NODE}"),
    ],
    ids=" ".join,
)
def test_a_node_gets_what_ros_gives_it(write, names, namespace):
    first, second = names
    path = write({first: {"object": "bunny", "seed": 1}, second: {"seed": 2}})
    assert parameters_of(read_params_file(path), NODE, namespace) == of_ros(path, namespace)


def test_without_file_and_options_the_defaults_are_those_of_the_nodes():
    context = Context()
    context.init(args=[], domain_id=fresh_domain())
    node = AttentionPolicyNode(context=context)
    settings = resolve(EpisodeSettings())
    assert (settings.object, settings.steps) == (node.value("object"), node.value("steps"))
    assert (ResolvedSettings.object, ResolvedSettings.steps) == (settings.object, settings.steps)
    node.destroy_node()
    context.try_shutdown()


def test_options_that_are_not_given_leave_the_file_alone(write):
    path = write({NODE: {"object": "bunny", "seed": 3}, "/**/attention_policy": {"policy": "random", "steps": 1}})
    settings = resolve(EpisodeSettings(params_file=path))
    assert (settings.object, settings.steps) == ("bunny", 1)
    nodes = describe(settings).nodes
    # The object is that of all nodes; what else the file says is not replaced.
    assert nodes == {
        NODE: {"object": "bunny"},
        "pose_estimator": {"object": "bunny"},
        "hypothesis_fusion": {"object": "bunny"},
        "attention_policy": {"object": "bunny", "steps": 1},
    }


def test_options_win_over_the_file_and_single_parameters_over_both(write):
    path = write({NODE: {"object": "bunny", "sensor": "time_of_flight"}, "attention_policy": {"steps": 1}})
    given = {"object": "mug", "seed": 7, "policy": "random", "steps": 2, "metres": 1, "sensor": "auto"}
    settings = resolve(EpisodeSettings(**given, params_file=path))
    nodes = describe(settings).nodes
    assert nodes[NODE] == {"object": "mug", "seed": 7, "sensor": "auto"}
    policy = {"object": "mug", "seed": 7, "policy": "random", "steps": 2, "metres": 1.0}
    assert nodes["attention_policy"] == policy
    single = {"attention_policy": {"steps": 4}, "pose_estimator": {"object": "coffee_cup"}}
    settings = resolve(EpisodeSettings(steps=2, overrides=single))
    assert (settings.object, settings.steps) == ("coffee_cup", 4)
    assert describe(settings).nodes[NODE]["object"] == "coffee_cup"


def test_different_objects_are_refused_by_the_names_of_the_nodes(write):
    path = write({"/**": {"object": "mug"}, "pose_estimator": {"object": "bunny"}})
    with pytest.raises(ValueError, match=rf"{path}: {NODE} has the object 'mug', but pose_estimator has 'bunny'"):
        resolve(EpisodeSettings(params_file=path))
    assert resolve(EpisodeSettings(object="mug", params_file=path)).object == "mug"


@pytest.mark.parametrize(("node", "wrong"), [("attention_policy", {"steps": "many"}), ("/**", {"object": 3})])
def test_a_value_of_another_type_is_refused(write, node, wrong):
    with pytest.raises(ValueError, match=rf"parameter '{next(iter(wrong))}' must be a"):
        resolve(EpisodeSettings(params_file=write({node: wrong})))


def test_sections_for_no_node_are_named(write):
    nodes = describe(resolve(EpisodeSettings())).nodes
    foreign = {"/**": {}, "bag_player": {}, "camera_driver": {}, "moveit": {}, f"/cell/{NODE}": {}}
    sections = read_params_file(write(foreign))
    assert unused_sections(sections, nodes) == [
        "active6d has no node 'camera_driver', did you mean 'camera_adapter'?; its parameters are not used",
        "active6d has no node 'moveit'; its parameters are not used",
        f"the parameters of '/cell/{NODE}' are not used: the node is /{NODE}",
    ]
    assert unused_sections(sections[-1:], nodes, "cell") == []
    assert unused_sections(read_params_file(default_params_file()), nodes, "cell") == []
