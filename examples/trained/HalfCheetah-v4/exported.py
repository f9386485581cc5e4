"""The policy and the rewards of a run of LaRe, in NumPy. This file needs the files in its directory, and nothing else of LaRe.

    import exported
    action = exported.load("policy")(observation=observation)["action"]
    r_hat = exported.reward(before, action, after)  # and length=STEPS of the episode, if `export.json` lists it

`export.json` lists the inputs and outputs of each function, with their shapes. Their first axis is the batch. If all inputs are
single rows, without this axis, the outputs have no batch axis either.
"""

import importlib.util
import json
from collections import namedtuple
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np

__all__ = ["load", "reward"]

_DIRECTORY = Path(__file__).parent
_Node = namedtuple("Node", "op inputs shape kind option")


@cache
def _evaluate_module():
    """Import `evaluate.py`, which computes graphs."""
    spec = importlib.util.spec_from_file_location("lare_evaluate", _DIRECTORY / "evaluate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def _describe(name):
    """Return the entry of a function in `export.json`."""
    description = json.loads((_DIRECTORY / "export.json").read_text(encoding="utf-8"))
    functions = [key for key, value in description.items() if isinstance(value, dict)]
    if name not in functions:
        raise ValueError(f"there is no function {name!r}, only {', '.join(functions)}")
    return description[name]


@cache
def _load_graph(name):
    description = _describe(name)
    with np.load(_DIRECTORY / f"{name}.npz", allow_pickle=False) as file:
        arrays = dict(file)
    nodes = []
    for i, (op, inputs, shape, kind, option) in enumerate(description["nodes"]):
        if op == "gather":
            slices = option and tuple(slice(*ends) for ends in option)
            option = SimpleNamespace(slices=slices, positions=arrays.get(str(i)))
        elif op == "constant":
            option = arrays[str(i)]
        elif isinstance(option, list):
            option = tuple(option)
        nodes.append(_Node(op, inputs, tuple(shape), kind, option))
    return SimpleNamespace(nodes=nodes, outputs=description["output_nodes"], unused_after=[[]] * len(nodes))


@cache
def load(name):
    """Load the function of NAME.npz. It takes arrays by name, and returns a dictionary of arrays."""
    description, graph = _describe(name), _load_graph(name)

    def function(**inputs):
        needed = ", ".join(description["inputs"])
        if missing := [key for key in description["inputs"] if key not in inputs]:
            length = " (length is the number of steps of the episode)" if "length" in missing else ""
            raise ValueError(f"{name} needs the inputs {needed}: {', '.join(missing)} is missing{length}")
        if unknown := [key for key in inputs if key not in description["inputs"]]:
            raise ValueError(f"{name} needs the inputs {needed}: there is no input {', '.join(unknown)}")
        arrays = {key: _as_array(key, inputs[key], spec) for key, spec in description["inputs"].items()}
        single = all(arrays[key].ndim < len(spec["shape"]) for key, spec in description["inputs"].items())
        rows = {key: array[None] for key, array in arrays.items()} if single else _repeat_rows(arrays, description)
        outputs = _evaluate_module().evaluate(graph, rows)
        outputs = {key: outputs[key].astype(spec["type"]) for key, spec in description["outputs"].items()}
        return {key: array[0] if single else array for key, array in outputs.items()}

    return function


def _as_array(key, values, spec):
    """Return an array. All axes but the first, the batch, must have the sizes that `export.json` lists."""
    array = np.asarray(values, spec["type"])
    sizes = tuple(spec["shape"][1:])
    if array.shape[array.ndim - len(sizes) :] != sizes:
        expected = ", ".join(map(str, spec["shape"]))
        raise ValueError(f"{key} must have the shape ({expected}), and has {array.shape}")
    return array


def _repeat_rows(arrays, description):
    """Return all arrays with the same batch axes. A single row among batches, such as the length of an episode, is repeated."""
    row_shapes = {key: spec["shape"][1:] for key, spec in description["inputs"].items()}
    batches = {key: array.shape[: array.ndim - len(row_shapes[key])] for key, array in arrays.items()}
    sizes = {batch for batch in batches.values() if batch}
    if len(sizes) > 1:
        listed = ", ".join(f"{key} {batch}" for key, batch in batches.items())
        raise ValueError(f"all inputs must have the same batch, and the batches are: {listed}")
    (batch,) = sizes
    return {key: np.broadcast_to(array, (*batch, *row_shapes[key])) for key, array in arrays.items()}


def reward(before, action, after, name="reward", **more):
    """Return the proxy rewards r_hat of steps, (batch, ...): phi and the decoder as one function.

    Observations and actions are (batch, ..., n), in the environment's units; a choice is its number, (batch, ...), or a one-hot
    row. `more` holds `length` and `alive`, if `export.json` lists them among the inputs.
    """
    action = _one_hot(before, action, _describe(name).get("choices"))
    inputs = {"before": before, "action": action, "after": after, **more}
    return load(name)(**{key: inputs[key] for key in _describe(name)["inputs"] if key in inputs})["r_hat"]


def _one_hot(before, action, choices):
    """Return actions as rows: the number of a choice becomes a one-hot row."""
    number = np.asarray(action)
    if choices is None or number.ndim != np.ndim(before) - 1:
        return action
    index, count = number - choices["first"], choices["count"]
    if number.dtype.kind not in "iu" or np.any((index < 0) | (index >= count)):
        raise ValueError(
            f"an action is a number from {choices['first']} to {choices['first'] + count - 1}, or a one-hot row"
        )
    return np.eye(count, dtype=np.float32)[index]
