#!/usr/bin/env python3
"""Time one network in several runtimes and precisions, on one view of a stored scene, and compare the outputs.

ONNX Runtime and OpenVINO are measured if they are installed: pip install onnx onnxruntime openvino

Example: python -m active6d_tools.studies.compare_runtimes coffee_cup --threads 2
"""

import logging
import time
import warnings
from collections.abc import Callable, Iterator
from copy import deepcopy
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from active6d_core.object_model import load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.dense.network import DenseNetwork, fused, split
from active6d_perception.estimators.dense.network_input import network_input, pad, reduce_view
from active6d_perception.estimators.dense.trained_network import load_network
from active6d_perception.estimators.registry import weights_path
from active6d_sim.rendering.simulator import Simulator
from active6d_sim.scenes.scene_store import load_scene
from active6d_tools.studies.arguments import study_parser

#: Runs the network on one input and returns its (channels, h, w) output.
Answer = Callable[[], np.ndarray]
_CALIBRATION_VIEWS = (3, 27, 48, 66, 90)


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--threads", type=int, default=1, help="threads of each runtime (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="timed runs (default: %(default)s)")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore")
    logging.disable(logging.WARNING)
    torch.set_num_threads(arguments.threads)
    model = load_object(arguments.object)
    network = load_network(weights_path(model.name), model).network
    simulator, sphere = Simulator(load_scene(model.name, "val", 0), seed=0), ViewSphere()
    inputs = [
        pad(network_input(reduce_view(simulator.capture(sphere.pose(sphere.positions[view]), 1)), model.diameter))[None]
        for view in _CALIBRATION_VIEWS
    ]
    title = f"{model.name}, threads: {arguments.threads}"
    table = Table("runtime", "wall clock ms", "CPU ms", "mean error of the axis", title=title)
    with TemporaryDirectory() as folder, torch.inference_mode():
        reference = network(torch.from_numpy(inputs[0]))[0].numpy()
        for name, answer in runtimes(network, inputs, arguments.threads, Path(folder)):
            clock, processor = measure(answer, arguments.repeats)
            table.add_row(name, f"{clock:.1f}", f"{processor:.1f}", f"{axis_error(answer(), reference):.4f}")
    Console().print(table)


def measure(answer: Answer, repeats: int) -> tuple[float, float]:
    """Median milliseconds of wall clock and of CPU time of all threads."""
    times = []
    for _ in range(repeats + 2):
        clock, processor = time.perf_counter(), time.process_time()
        answer()
        times.append((time.perf_counter() - clock, time.process_time() - processor))
    clock, processor = 1e3 * np.median(times[2:], axis=0)
    return float(clock), float(processor)


def axis_error(answer: np.ndarray, reference: np.ndarray) -> float:
    """Mean distance between the axes in two outputs, over the object pixels of the reference."""
    on_object = reference[0] > 0
    axes = [split(each, axis=0)["axis"][:, on_object] for each in (answer, reference)]
    return float(np.linalg.norm(axes[0] - axes[1], axis=0).mean())


def runtimes(
    network: DenseNetwork, inputs: list[np.ndarray], threads: int, folder: Path
) -> Iterator[tuple[str, Answer]]:
    """Name of every installed runtime, and a function that runs it on the first input."""
    yield from torch_runtimes(network, inputs)
    if not find_spec("onnx"):
        return
    path = folder / "network.onnx"
    example = torch.from_numpy(inputs[0])
    torch.onnx.export(fused(network), (example,), path, input_names=["x"], output_names=["y"], dynamo=False)
    if find_spec("onnxruntime"):
        yield from onnx_runtimes(path, inputs, threads)
    if find_spec("openvino"):
        yield from openvino_runtimes(path, inputs, threads)


def torch_runtimes(network: DenseNetwork, inputs: list[np.ndarray]) -> Iterator[tuple[str, Answer]]:
    """Memory format, merged normalisation, precision, quantisation."""
    plain = torch.from_numpy(inputs[0])
    last = plain.contiguous(memory_format=torch.channels_last)
    unmerged, merged = cast(Any, deepcopy(network)), cast(Any, fused(network))
    unmerged.to(memory_format=torch.channels_last)
    merged.to(memory_format=torch.channels_last)
    half, half_input = deepcopy(merged).to(torch.bfloat16, memory_format=torch.channels_last), last.bfloat16()
    yield "torch, float32", lambda: network(plain)[0].numpy()
    yield "torch, float32, channels last", lambda: unmerged(last)[0].numpy()
    yield "torch, float32, channels last, merged", lambda: merged(last)[0].numpy()
    yield "torch, bfloat16, channels last, merged", lambda: half(half_input)[0].float().numpy()


def onnx_runtimes(path: Path, inputs: list[np.ndarray], threads: int) -> Iterator[tuple[str, Answer]]:
    """float32, and int8 calibrated on the inputs."""
    import onnxruntime
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, quantize_static

    class Views(CalibrationDataReader):
        def __init__(self) -> None:
            self._left = iter({"x": each} for each in inputs)

        def get_next(self) -> dict[str, np.ndarray] | None:
            return next(self._left, None)

    quantised = path.with_name("int8.onnx")
    quantize_static(path, quantised, Views(), quant_format=QuantFormat.QDQ, per_channel=True)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    for name, file in (("float32", path), ("int8", quantised)):
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
        yield f"ONNX Runtime, {name}", lambda: session.run(None, {"x": inputs[0]})[0][0]  # noqa: B023 (runs at once)


def openvino_runtimes(path: Path, inputs: list[np.ndarray], threads: int) -> Iterator[tuple[str, Answer]]:
    """float32 and bfloat16."""
    import openvino

    core = openvino.Core()
    for name, hint in (("float32", "f32"), ("bfloat16", "bf16")):
        settings = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": hint, "PERFORMANCE_HINT": "LATENCY"}
        request = core.compile_model(core.read_model(path), "CPU", settings).create_infer_request()
        yield f"OpenVINO, {name}", lambda: np.array(request.infer({0: inputs[0]})[0][0])  # noqa: B023 (runs at once)


if __name__ == "__main__":
    main()
