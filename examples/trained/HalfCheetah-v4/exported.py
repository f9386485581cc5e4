"""The policy and the rewards of a run of LaRe, in NumPy. This file needs the files in its directory, and nothing else of LaRe.

    import exported
    action = exported.load("policy")(observation=observation)["action"]
    r_hat = exported.reward(before, action, after)  # and length=STEPS that the payment is for, if `export.json` lists it

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
def _read_entry(name):
    """Return the entry of a function in `export.json`."""
    export = json.loads((_DIRECTORY / "export.json").read_text(encoding="utf-8"))
    functions = [key for key, value in export.items() if isinstance(value, dict)]
    if name not in functions:
        raise ValueError(f"there is no function {name!r}, only {', '.join(functions)}")
    return export[name]


@cache
def _load_graph(name):
    """Return a graph as `evaluate.py` reads it: its operations and, for each output, the index of the operation that computes it."""
    entry = _read_entry(name)
    with np.load(_DIRECTORY / f"{name}.npz", allow_pickle=False) as file:
        arrays = dict(file)
    nodes = []
    for i, (op, inputs, shape, kind, option) in enumerate(entry["nodes"]):
        if op == "gather":
            slices = None if option is None else tuple(slice(*bounds) for bounds in option)
            option = SimpleNamespace(slices=slices, positions=arrays.get(str(i)))
        elif op == "constant":
            option = arrays[str(i)]
        elif isinstance(option, list):
            option = tuple(option)
        nodes.append(_Node(op, inputs, tuple(shape), kind, option))
    # `unused_after` lists the results that may be deleted after each operation. Here none are deleted.
    return SimpleNamespace(nodes=nodes, outputs=entry["output_nodes"], unused_after=[[]] * len(nodes))


@cache
def load(name):
    """Load the function of NAME.npz. It takes arrays by name, and returns a dictionary of arrays."""
    entry, graph = _read_entry(name), _load_graph(name)

    def function(**inputs):
        needed = ", ".join(entry["inputs"])
        if missing := [key for key in entry["inputs"] if key not in inputs]:
            length = (
                " (length is the number of steps that the payment is for: of the episode, if it is paid once)"
                if "length" in missing
                else ""
            )
            raise ValueError(f"{name} needs the inputs {needed}: {', '.join(missing)} is missing{length}")
        if unknown := [key for key in inputs if key not in entry["inputs"]]:
            raise ValueError(f"{name} needs the inputs {needed}: there is no input {', '.join(unknown)}")
        arrays = {key: _as_array(key, inputs[key], spec) for key, spec in entry["inputs"].items()}
        is_single = all(arrays[key].ndim < len(spec["shape"]) for key, spec in entry["inputs"].items())
        batch = {key: array[None] for key, array in arrays.items()} if is_single else _repeat_rows(arrays, entry)
        outputs = _evaluate_module().evaluate(graph, batch)
        outputs = {key: outputs[key].astype(spec["type"]) for key, spec in entry["outputs"].items()}
        return {key: array[0] if is_single else array for key, array in outputs.items()}

    return function


def _as_array(key, values, spec):
    """Return the values as an array. Its last axes must have the sizes that `export.json` lists after the batch."""
    array = np.asarray(values, spec["type"])
    sizes = tuple(spec["shape"][1:])
    if key == "length" and array.ndim == 0:
        array = array.reshape(sizes)  # (1,) if there are agents
    if array.shape[array.ndim - len(sizes) :] != sizes:
        expected = ", ".join(map(str, spec["shape"]))
        raise ValueError(f"{key} must have the shape ({expected}), and has {array.shape}")
    return array


def _repeat_rows(arrays, entry):
    """Return all arrays with the same batch axes. A single row among batches, such as the length of an episode, is repeated."""
    row_shapes = {key: spec["shape"][1:] for key, spec in entry["inputs"].items()}
    batch_shapes = {key: array.shape[: array.ndim - len(row_shapes[key])] for key, array in arrays.items()}
    distinct_shapes = {shape for shape in batch_shapes.values() if shape}  # a single row has the shape ()
    if len(distinct_shapes) > 1:
        listed = ", ".join(f"{key} {shape}" for key, shape in batch_shapes.items())
        raise ValueError(f"all inputs must have the same batch, and the batches are: {listed}")
    (batch_shape,) = distinct_shapes
    return {key: np.broadcast_to(array, (*batch_shape, *row_shapes[key])) for key, array in arrays.items()}


def reward(before, action, after, name="reward", **more):
    """Return the proxy rewards r_hat of steps: phi and the decoder as one function.

    Args:
        before: the observations before the steps, (batch, n), or (batch, agents, n) if `export.json` lists an axis of agents.
        action: the actions in the environment's units, with the same axes. A discrete action is its number, without the last axis,
            or a one-hot row.
        after: the observations after the steps.
        name: the function: `reward`, or `reward_TEAM` if `export.json` lists several.
        more: `length` and `alive`, if `export.json` lists them among the inputs.

    Returns:
        (batch,) or (batch, agents).
    """
    action = _one_hot(before, action, _read_entry(name).get("choices"))
    inputs = {"before": before, "action": action, "after": after, **more}
    return load(name)(**{key: inputs[key] for key in _read_entry(name)["inputs"] if key in inputs})["r_hat"]


def _one_hot(before, action, choices):
    """Return actions as rows: the number of a discrete action becomes a one-hot row."""
    number = np.asarray(action)
    if choices is None or number.ndim != np.ndim(before) - 1:  # continuous, or rows already
        return action
    index, count = number - choices["first"], choices["count"]
    if number.dtype.kind not in "iu" or np.any((index < 0) | (index >= count)):
        raise ValueError(
            f"an action is a number from {choices['first']} to {choices['first'] + count - 1}, or a one-hot row"
        )
    return np.eye(count, dtype=np.float32)[index]
