"""The policy and the rewards of a run of LaRe, in NumPy alone. This file needs the files beside it, and nothing else of LaRe.

    import exported
    action = exported.load("policy")(observation=observation)["action"]
    r_hat = exported.reward(before, action, after)  # and length=STEPS of the episode, if `export.json` lists it

`export.json` lists the inputs and outputs of each function, with their shapes. The first axis of all of them is the batch. A
single row may be given without this axis; then the outputs have none either.
"""

import importlib.util
import json
from collections import namedtuple
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np

HERE = Path(__file__).parent
LENGTH = "length is the number of steps of the whole episode, because the score is an average over the steps"
Node = namedtuple("Node", "op inputs shape kind option")


@cache
def evaluation():
    """The module `evaluate.py`, which computes graphs."""
    spec = importlib.util.spec_from_file_location("lare_evaluate", HERE / "evaluate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def described(name):
    """The entry of a function in `export.json`."""
    text = json.loads((HERE / "export.json").read_text(encoding="utf-8"))
    functions = [key for key, value in text.items() if isinstance(value, dict)]
    if name not in functions:
        raise ValueError(f"there is no function {name!r}, only {', '.join(functions)}")
    return text[name]


@cache
def graph_of(name):
    """The graph of a function."""
    text = described(name)
    with np.load(HERE / f"{name}.npz", allow_pickle=False) as file:
        arrays = dict(file)
    nodes = []
    for i, (op, inputs, shape, kind, option) in enumerate(text["nodes"]):
        if op == "gather":
            slices = option and tuple(slice(*ends) for ends in option)
            option = SimpleNamespace(slices=slices, positions=arrays.get(str(i)))
        elif op == "constant":
            option = arrays[str(i)]
        elif isinstance(option, list):
            option = tuple(option)
        nodes.append(Node(op, inputs, tuple(shape), kind, option))
    return SimpleNamespace(nodes=nodes, outputs=text["output_nodes"], unused_after=[[]] * len(nodes))


@cache
def load(name):
    """The function of NAME.npz. It takes arrays by name, and returns a dictionary of arrays."""
    text, graph = described(name), graph_of(name)

    def function(**inputs):
        needed = ", ".join(text["inputs"])
        if missing := [key for key in text["inputs"] if key not in inputs]:
            raise ValueError(
                f"{name} needs the inputs {needed}: {', '.join(missing)} is missing"
                + (f" ({LENGTH})" if "length" in missing else "")
            )
        if unknown := [key for key in inputs if key not in text["inputs"]]:
            raise ValueError(f"{name} needs the inputs {needed}: there is no input {', '.join(unknown)}")
        arrays = {key: as_input(key, inputs[key], like) for key, like in text["inputs"].items()}
        single = all(arrays[key].ndim < len(like["shape"]) for key, like in text["inputs"].items())
        rows = {key: array[None] if single else array for key, array in arrays.items()}
        outputs = evaluation().evaluate(graph, rows)
        outputs = {key: outputs[key].astype(like["type"]) for key, like in text["outputs"].items()}
        return {key: array[0] if single else array for key, array in outputs.items()}

    return function


def as_input(key, values, like):
    """Numbers as an array. All axes but the first, the batch, must have the sizes that `export.json` lists."""
    array = np.asarray(values, like["type"])
    sizes = tuple(like["shape"][1:])
    if array.shape[array.ndim - len(sizes) :] != sizes:
        expected = ", ".join(map(str, like["shape"]))
        raise ValueError(f"{key} must have the shape ({expected}), and has {array.shape}")
    return array


def reward(before, action, after, name="reward", **more):
    """The proxy rewards r_hat of steps, (batch, ...): phi and the decoder as one function.

    Observations and actions are (batch, ..., n), in the environment's units; a choice is its number, (batch, ...), or a one-hot
    row. `more` holds `length` or `alive`, if `export.json` lists them among the inputs.
    """
    action = one_hot(before, action, described(name).get("choices"))
    inputs = {"before": before, "action": action, "after": after, **more}
    return load(name)(**{key: inputs[key] for key in described(name)["inputs"] if key in inputs})["r_hat"]


def one_hot(before, action, choices):
    """Actions as rows: choices that are given as numbers become one-hot rows."""
    number = np.asarray(action)
    if choices is None or number.ndim != np.ndim(before) - 1:
        return action
    index, count = number - choices["first"], choices["count"]
    if number.dtype.kind not in "iu" or np.any((index < 0) | (index >= count)):
        raise ValueError(
            f"an action is a number from {choices['first']} to {choices['first'] + count - 1}, or a one-hot row"
        )
    return np.eye(count, dtype=np.float32)[index]
