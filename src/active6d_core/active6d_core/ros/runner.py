"""The main function of every node's executable."""

import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.utilities import remove_ros_args

from active6d_core.ros.graph_nodes import BAD_PARAMETERS
from active6d_core.ros.network import describe_reach, domain_of, explain_start
from active6d_core.ros.node import GraphNode

_WAKE_SECONDS = 1.0


def run_node(node_type: Callable[[], GraphNode], args: Sequence[str] | None = None) -> None:
    """Spin one node until interrupted. Exit code 2 on bad arguments."""
    _refuse_words(list(sys.argv if args is None else args))
    try:
        domain_of()
        rclpy.init(args=args)
    except ValueError as error:
        _refuse(str(error))
    except RuntimeError as error:
        _refuse(explain_start(error))
    node = None
    try:
        try:
            node = _create(node_type)
            node.get_logger().info(f"domain {node.context.get_domain_id()}, can be reached {describe_reach()}")
            if node.value("autostart"):
                node.start()
        # Only here: a ValueError in a callback is a defect, which needs its traceback and the supervisor's restart.
        except ValueError as error:
            _refuse(str(error))
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # Not spin(): on an interrupt rclpy wakes the executor a moment before it ends the context, and one that waits
        # again in that moment would sleep until the next message.
        while rclpy.ok():
            executor.spin_once(timeout_sec=_WAKE_SECONDS)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        # An interrupt between the executor's look at the context and its wait ends in rcl's own error.
        if rclpy.ok():
            raise
    finally:
        # A terminal and `ros2 launch` both interrupt their children: the second must not tear the clean-up.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _create(node_type: Callable[[], GraphNode]) -> GraphNode:
    """The node; one line and exit code 1 where the system refuses threads, files or memory to the middleware."""
    try:
        return node_type()
    except (RuntimeError, MemoryError) as error:
        if os.environ.get("ACTIVE6D_TRACEBACK"):
            raise
        print(f"error: the node cannot be created: {error or type(error).__name__}", file=sys.stderr)
        sys.exit(1)


def _refuse(text: str) -> NoReturn:
    print(f"error: {text}", file=sys.stderr)
    sys.exit(BAD_PARAMETERS)


def _refuse_words(arguments: list[str]) -> None:
    """End with usage, or with an error: rclpy would drop silently what stands before ``--ros-args``."""
    try:
        words = remove_ros_args(arguments)[1:]
    except RuntimeError as error:
        _refuse(_explain_arguments(error))
    if not words:
        return
    usage = f"usage: {Path(arguments[0]).stem} [--ros-args -p NAME:=VALUE ... --params-file FILE]"
    if set(words) & {"-h", "--help"}:
        print(f"{usage}\nparameters and topics: docs/graph.md, or `ros2 param describe` while it runs")
        sys.exit(0)
    _refuse(f"'{words[0]}' is not for a node; parameters come after --ros-args\n{usage}")


def _explain_arguments(error: RuntimeError) -> str:
    """What is wrong with a parameter file or another argument, from the words of rcl, and what to do."""
    found = re.search(r"'(?:--params-file|--param|-p) (?P<what>.*?)'\. Error: (?P<reason>.*)", str(error), re.DOTALL)
    if found is None:
        return " ".join(str(error).split())
    where = f"params file {found['what']}" if "--params-file" in found[0] else f"parameter {found['what']}"
    # The rest is where in rcl's own source it was noticed.
    reason = " ".join(found["reason"].partition(", at /")[0].split())
    if "opening YAML file" in reason:
        return f"{where} does not exist or cannot be read; name another one after --params-file"
    line = re.search(r"line(?:_num)? (\d+)", reason)
    where += f", line {line[1]}" if line and "--params-file" in found[0] else ""
    if "same type" in reason:
        return f"{where}: the values of a list differ in type; write 0.0 in place of 0 where others are not whole"
    # The latter is what rcl says of a list right below the node's name.
    if "ros__parameters" in reason or "not keys" in reason:
        return f"{where}: {reason}; the file must hold NODE: {{ros__parameters: {{NAME: VALUE}}}}"
    return f"{where}: {reason}; correct it, or leave it out"
