"""A graph as an ONNX model (https://onnx.ai), for runtimes in other languages and on other devices."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lare.deploy.graph import BATCH, Graph
from lare.files import write_atomically

OPSET = 17
"""Version of ONNX's operations. Runtimes of 2022 and later know it."""
ATTRIBUTES: dict[str, dict[str, Any]] = {"ArgMax": {"axis": -1, "keepdims": 0}, "Concat": {"axis": -1}}


def is_installed() -> bool:
    """Whether the package `onnx` is there."""
    return find_spec("onnx") is not None


def write(graph: Graph, path: Path, name: str) -> None:
    """Write the model. Raises `LareError` where the file cannot be written."""
    data = model(graph, name).SerializeToString()
    write_atomically(path, lambda file: file.write(data))


def model(graph: Graph, name: str) -> Any:
    """The model, checked by ONNX itself."""
    import onnx
    from onnx import helper, numpy_helper

    def described(shapes: Mapping[str, tuple[int, ...]]) -> list[Any]:
        kinds = {key: helper.np_dtype_to_tensor_dtype(np.dtype(graph.kinds[key])) for key in shapes}
        return [helper.make_tensor_value_info(key, kinds[key], (BATCH, *shape)) for key, shape in shapes.items()]

    nodes = [
        helper.make_node(one.name, one.arguments, [one.result], **ATTRIBUTES.get(one.name, {}))
        for one in graph.operations
    ]
    made = helper.make_graph(
        nodes,
        name,
        described(graph.inputs),
        described(graph.outputs),
        [numpy_helper.from_array(value, key) for key, value in graph.constants.items()],
    )
    found = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="lare", ir_version=9)
    onnx.checker.check_model(found)
    return found
