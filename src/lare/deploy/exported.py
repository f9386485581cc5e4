"""The policy and the rewards of a run of LaRe, in NumPy alone. This file needs the files beside it, and nothing else of LaRe.

    import exported
    action = exported.load("policy")(observation=observation)["action"]
    r_hat = exported.reward(before, action, after)  # and length=STEPS of the episode, if `export.json` lists it

`export.json` lists the inputs and outputs of each function, with their shapes. The first axis of all of them is the batch. A
single row may be given without this axis; then the outputs have none either.
"""

import json
from functools import cache
from pathlib import Path
from runpy import run_path

import numpy as np

HERE = Path(__file__).parent
LENGTH = "length is the number of steps of the whole episode, because the score is an average over the steps"
OPERATIONS = {
    "Add": np.add,
    "Sub": np.subtract,
    "Mul": np.multiply,
    "Div": np.divide,
    "Pow": np.power,
    "Max": np.maximum,
    "Min": np.minimum,
    "Neg": np.negative,
    "Abs": np.abs,
    "Sign": np.sign,
    "Floor": np.floor,
    "Ceil": np.ceil,
    "Round": np.rint,
    "Sqrt": np.sqrt,
    "Reciprocal": np.reciprocal,
    "Exp": np.exp,
    "Log": np.log,
    "Cos": np.cos,
    "Sin": np.sin,
    "Tanh": np.tanh,
    "Less": np.less,
    "LessOrEqual": np.less_equal,
    "Greater": np.greater,
    "GreaterOrEqual": np.greater_equal,
    "Equal": np.equal,
    "And": np.logical_and,
    "Or": np.logical_or,
    "Not": np.logical_not,
    "Where": np.where,
    "MatMul": np.matmul,
    "Reshape": np.reshape,
    "Identity": lambda x: x,
    "Cast": lambda x: x.astype(np.float32),
    "Relu": lambda x: np.maximum(x, 0),
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "ArgMax": np.argmax,
    "ArgMin": np.argmin,
    "Concat": lambda *parts, axis: np.concatenate(parts, axis=axis),
    "Gather": lambda table, number: table[number],
    "Squeeze": lambda x, axes: np.squeeze(x, tuple(axes)),
    "Unsqueeze": lambda x, axes: np.expand_dims(x, tuple(axes)),
    "Slice": lambda x, start, end, axis, step: np.moveaxis(
        np.moveaxis(x, axis[0], 0)[start[0] : end[0] : step[0]], 0, axis[0]
    ),
    "ReduceSum": lambda x, axes: np.sum(x, tuple(axes), keepdims=True),
    "ReduceMean": lambda x, axes: np.mean(x, tuple(axes), keepdims=True),
    "ReduceMax": lambda x, axes: np.max(x, tuple(axes), keepdims=True),
    "ReduceMin": lambda x, axes: np.min(x, tuple(axes), keepdims=True),
    "ReduceProd": lambda x, axes: np.prod(x, tuple(axes), keepdims=True),
}


@cache
def described(name):
    """The entry of a function in `export.json`."""
    text = json.loads((HERE / "export.json").read_text(encoding="utf-8"))
    functions = [key for key, value in text.items() if isinstance(value, dict)]
    if name not in functions:
        raise ValueError(f"there is no function {name!r}, only {', '.join(functions)}")
    return text[name]


@cache
def load(name):
    """The function of NAME.npz. It takes arrays by name, and returns a dictionary of arrays."""
    graph = described(name)
    with np.load(HERE / f"{name}.npz", allow_pickle=False) as file:
        constants = dict(file)

    def function(**inputs):
        needed = ", ".join(graph["inputs"])
        if missing := [key for key in graph["inputs"] if key not in inputs]:
            raise ValueError(
                f"{name} needs the inputs {needed}: {', '.join(missing)} is missing"
                + (f" ({LENGTH})" if "length" in missing else "")
            )
        if unknown := [key for key in inputs if key not in graph["inputs"]]:
            raise ValueError(f"{name} needs the inputs {needed}: there is no input {', '.join(unknown)}")
        given = {key: as_input(key, inputs[key], like) for key, like in graph["inputs"].items()}
        single = all(given[key].ndim < len(like["shape"]) for key, like in graph["inputs"].items())
        values = constants | {key: array[None] if single else array for key, array in given.items()}
        for operation, arguments, result, axis in graph["operations"]:
            more = {} if axis is None else {"axis": axis}
            values[result] = OPERATIONS[operation](*(values[argument] for argument in arguments), **more)
        return {key: values[key][0] if single else values[key] for key in graph["outputs"]}

    return function


def as_input(key, given, like):
    """The given numbers as an array. All axes but the first, the batch, must have the sizes that `export.json` lists."""
    array = np.asarray(given, like["type"])
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
    given = {"before": before, "action": action, "after": after, **more}
    if "factors" in described(name)["inputs"]:
        given["factors"] = factors(before, action, after, name)
    return load(name)(**{key: given[key] for key in described(name)["inputs"] if key in given})["r_hat"]


def one_hot(before, action, choices):
    """Actions as rows: choices that are given as numbers become one-hot rows."""
    number = np.asarray(action)
    if choices is None or number.ndim != np.ndim(before) - 1:
        return action
    place, count = number - choices["first"], choices["count"]
    if number.dtype.kind not in "iu" or np.any((place < 0) | (place >= count)):
        raise ValueError(
            f"an action is a number from {choices['first']} to {choices['first'] + count - 1}, or a one-hot row"
        )
    return np.eye(count, dtype=np.float32)[place]


def factors(before, action, after, name="reward"):
    """The factors phi(s, a) of steps, (batch, ..., factors), for a phi that could not be made a part of NAME.npz.

    A language model has written phi, and it has passed LaRe's checks. Here it runs in this process, without LaRe's sandbox.
    """
    phi = run_path(str(HERE / described(name)["phi"]))["evaluation_func"]
    rows = {"before": np.asarray(before, np.float32), "after": np.asarray(after, np.float32)}
    action, found = np.asarray(action, np.float32), []
    for judged in described(name)["judges"]:
        shown = rows[judged]
        found += phi(shown.reshape(-1, shown.shape[-1]), action.reshape(-1, action.shape[-1]))
    return np.concatenate(found, axis=1).reshape(*action.shape[:-1], -1).astype(np.float32)
