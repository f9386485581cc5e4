"""A graph as an ONNX model (https://onnx.ai), for runtimes in other languages and on other devices."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lare.deploy.graph import BATCH, Graph, Operation
from lare.files import write_atomically

OPSET = 18
"""Version of ONNX's operations. Runtimes of 2023 and later support it."""
ATTRIBUTES: dict[str, dict[str, Any]] = {"ArgMax": {"keepdims": 0}, "ArgMin": {"keepdims": 0}, "Cast": {"to": 1}}
"""`to` 1 is float32."""


def is_installed() -> bool:
    """Whether the package `onnx` is installed."""
    return find_spec("onnx") is not None


def attributes_of(operation: Operation) -> dict[str, Any]:
    """The arguments of an operation that are attributes in ONNX, not arrays."""
    found = ATTRIBUTES.get(operation.name, {})
    return found if operation.axis is None else found | {"axis": operation.axis}


def write(graph: Graph, path: Path, name: str) -> None:
    """Write the model. Raises `LareError` if the file cannot be written."""
    data = model(graph, name).SerializeToString()
    write_atomically(path, lambda file: file.write(data))


def model(graph: Graph, name: str) -> Any:
    """The model, checked by ONNX itself."""
    import onnx
    from onnx import helper, numpy_helper

    def described(shapes: Mapping[str, tuple[int, ...]]) -> list[Any]:
        kinds = {key: helper.np_dtype_to_tensor_dtype(np.dtype(graph.kinds[key])) for key in shapes}
        return [helper.make_tensor_value_info(key, kinds[key], (BATCH, *shape)) for key, shape in shapes.items()]

    nodes = [helper.make_node(one.name, one.arguments, [one.result], **attributes_of(one)) for one in graph.operations]
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
