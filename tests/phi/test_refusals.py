"""What is refused, with the rule, the line, and the words that tell an author what to write instead."""

import pytest

from helpers.phi_programs import hostile_programs
from helpers.toy_envs import phi_source
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read

RETURN = "\n" + phi_source("return [observation[:, :1]]")
SOURCES = {
    "def f(:\n": "E-SYNTAX line 1: ",
    "def evaluation_func(o, a):\nreturn 1": "E-SYNTAX line 2: ",
    "x = 1  # \u202e": "E-SYNTAX line 1: no reader sees",
    "x = 1  # \u2028import os": "E-SYNTAX line 1: no reader sees",
    "x = 1": "E-FORM line 1: evaluation_func",
    "return 1": "E-SYNTAX line 1: outside a function",
    "import os" + RETURN: "E-IMPORT line 1: use numpy and math",
    "from .tools import f" + RETURN: "E-IMPORT line 1: .tools",
    "async def f():\n    pass\n": "E-PYTHON line 1: async",
    "n = []\n" + phi_source("n.append(1)\nreturn [observation[:, :1] * len(n)]"): "E-STATE line 4: second call",
    "def f(x):\n    return f(x)\n" + phi_source("return [f(observation)]"): "E-COST line 2: calls",
}
BODIES = {
    "return [np.load('x')]": "E-NUMPY line 3: no files",
    "return [np.sqroot(observation)]": "E-NUMPY line 3: np.sqrt",
    "return [np.random.rand(3)]": "E-NUMPY line 3: chance",
    "return [np.sum(observation, axes=1)]": "E-NUMPY line 3: axis",
    "return [observation.sum(axis=1, dtype=int)]": "E-NUMPY line 3: astype",
    "return [observation.flatten('F')]": "E-ROWS line 3: mixed",
    "return [np.flip(observation)]": "E-ROWS line 3: (batch, 17)",
    "return [np.delete(observation, slice(5, None), axis=0)]": "E-ROWS line 3: axis=1",
    "return [np.insert(observation, 2, action[:, :1], axis=1)]": "E-ROWS line 3: mixed",
    "return [action.reshape(3, -1)]": "E-ROWS line 3: (batch, 6)",
    "return [np.concatenate([observation, action])]": "E-RUN line 3: (batch, 17) and (batch, 6)",
    "return [np.concatenate([action, action])]": "E-ROWS line 3: (batch, 6)",
    "return [np.array_split(action, np.array(10 ** 9))]": "E-COST line 3: too large",
    "return [np.hanning(1e5)[0] * action]": "E-COST line 3: np.hanning of more than 1024",
    "return [np.putmask(action.copy(), action > 0, [1.0, 2.0])]": "E-NUMPY line 3: np.where",
    "return [np.logaddexp.reduce(action, axis=1, initial=1.0)]": "E-NUMPY line 3: initial=",
    "return [np.linspace(0, 1, 5, True, True)]": "E-RUN line 3: base",
    "y = np.zeros(2)\ny.flat[0] = 1\nreturn [y]": "E-RUN line 4: into a tuple",
    "return [len(','.join([1]))]": "E-RUN line 3: expected str",
    "return [np.unravel_index(7, (3, 4), order='F')[0] * observation]": "E-NUMPY line 3: np.transpose",
    "return [np.polynomial.Polynomial([1, 2], domain=[0, 1])(observation)]": "E-NUMPY line 3: domain",
    "return [obs[:, :1]]": "E-RUN line 3: obs is not defined",
    "return [observation.__class__]": "E-ATTRIBUTE line 3: __class__",
    "return [observation.normalize()]": "E-ATTRIBUTE line 3: function of NumPy",
    "return [(1j * action).roll(1)]": "E-NUMPY line 3: np.abs",
    "return [zip([2], [1]).sort()]": "E-ATTRIBUTE line 3: an iterator",
    "return [action[:, np.array([True, False])]]": "E-RUN line 3: (2,)",
    "return [action[..., [True, False]]]": "E-RUN line 3: (2,)",
    "return [np.fromiter([1, 2], float, count=3)[0] * action]": "E-RUN line 3: IndexError",
    "return [math.fsum([action[:, :1]])]": "E-FLOW line 3: differs from row to row",
    "try:\n    [][1]\nexcept IndexError:\n    raise": "E-RUN line 6: IndexError",
    "try:\n    [][1]\nexcept IndexError as e:\n    raise e": "E-RUN line 6: IndexError",
    "if observation[0, 0] > 0:\n    pass\nreturn [1]": "E-ROWS line 3: one row for all",
    "x = observation.sum(axis=1)\nif x > 0:\n    pass": "E-FLOW line 4: np.where",
    "return [max(observation[:, :1], 0)]": "E-FLOW line 3: np.maximum",
    "return [math.sqrt(observation[:, :1])]": "E-FLOW line 3: np.sqrt",
    "return [float(observation[:, 0])]": "E-FLOW line 3: astype",
    "return [observation - observation.mean(axis=0)]": "E-ROWS line 3: axis=1",
    "for row in observation:\n    pass": "E-ROWS line 3: loop",
    "return [observation[:, :1] / len(observation)]": "E-ROWS line 3: number of rows",
    "return [observation[:, :1] * action[:, 0]]": "E-ROWS line 3: [:, None]",
    "return [observation[::-1, :1]]": "E-ROWS line 3: x[:, i]",
    "return [np.arange(len(action))[:, None] * 1.0]": "E-ROWS line 3: number of its row",
    "return [np.einsum('bi,ci->bc', action, action)]": "E-ROWS line 3: rows",
    "return [observation[observation > 0].mean()]": "E-ROWS line 3: np.where",
    "return [np.unique(observation)]": "E-NUMPY line 3: count with comparisons",
    "return [np.linalg.svd(observation)[1]]": "E-NUMPY line 3: for 2 x 2 matrices",
    "return [np.nonzero(observation)]": "E-NUMPY line 3: same for all rows",
    "return [observation[:, 40]]": "E-RUN line 3: IndexError",
    "return list(np.insert(observation, -40, 0.0, axis=1).T)": "E-RUN line 3: IndexError",
    "return [observation[:, 40:41]]": "E-INDEX line 3: beyond the end",
    "return [observation + action]": "E-RUN line 3: ValueError",
    "return [observation[:, :1] + np.ones((5, 1))]": "E-RUN line 3: for any number of rows",
    "return [np.zeros((len(action), 0))]": "E-INDEX line 3: empty",
    "observation[:, 0] = 1\nreturn [1]": "E-RUN line 3: copy",
    "raise ValueError('no')": "E-RUN line 3: no",
    "assert observation.shape[1] == 18, 'size'\nreturn [1]": "E-RUN line 3: size",
    "return observation[:, :1]": "E-FORM line 3: list",
    "return [observation[:, :2]]": "E-FORM line 3: (batch, 2)",
    "return [np.zeros((5, 1))]": "E-FORM line 3: (5, 1)",
    "return []": "E-FORM line 3: 1 to 32",
    "while True:\n    pass": "E-COST line 3: steps",
    "def f(x):\n    return x\nreturn [f(observation) + observation[:, 40]]": "E-RUN line 5: IndexError",
    "c = np.zeros(6)\nc[np.argmax(action, axis=1)] = 1\nreturn [c]": "E-ROWS line 4: (batch, n)",
    "return [np.apply_along_axis(lambda r: r.sum() + action[:, 0], 1, action)[:, :1]]": "E-ROWS line 3: its own argument",
    "return [observation[:, :len(observation)]]": "E-ROWS line 3: columns",
    "y = observation[:, :2].reshape(len(action) * 2, 1)\nr = np.arange(len(action) * 2).reshape(len(action), 2)[:, ::-1]\n"
    "return [y[r, 0][:, :1]]": "E-ROWS line 5: np.arange(len(x))",
    "return [np.gradient(observation, np.arange(3.0), axis=1)]": "E-RUN line 3: positions",
    "return [observation[[0, 1]]]": "E-ROWS line 3: x[:, i]",
    "x = np.arange(6)\nx[2:] += 0.5\nreturn [x * action]": "E-RUN line 4: x = x + y",
    "a, *b, c = [1.0]\nreturn [a * action]": "E-RUN line 3: unpacked",
    "return [np.zeros((1000, 1000))]": "E-COST line 3: 1000000",
    "x = observation\nfor _ in range(500):\n    x = np.sin(x)\nreturn [x]": "E-COST line 5: line 5 (399)",
    "for _ in range(99):\n    x = observation[:, :, None] + np.ones(3000)\nreturn [x[:, :1, 0]]": "E-COST line 4: line 4 (2",
    "x = observation[:, :, None] + np.ones(2000)\nreturn [x.sum((1, 2))[:, None]]": "E-COST line 4: line 3 (34",
    "return [np.linalg.eigvalsh(observation[:, :16].reshape(-1, 4, 4))]": "E-NUMPY line 3: 3 x 3",
    "return [np.sqrt(1j * observation)]": "E-NUMPY line 3: np.abs",
    "return [(1j * action) @ np.ones(6)]": "E-NUMPY line 3: np.abs",
    "return [np.power(1j * action, 2.5)]": "E-NUMPY line 3: 1 to 8",
    # What a message says of a value is its type in Python.
    "return [np.sum(np.sin)]": "E-RUN line 3: no array can be made of np.sin",
    "return [np.sum(observation.sum)]": "E-RUN line 3: no array can be made of a function",
    "return [observation.T()]": "E-RUN line 3: an array cannot be called",
    "return {1: action}": "E-FORM line 3: not a dict",
    "return [observation.tolist(1)]": "E-PYTHON line 3: too many positional arguments",
    "return [observation.astype(None)]": "E-NUMPY line 3: None is",
    "return [observation.astype(lambda x: x)]": "E-NUMPY line 3: a function is",
    "return [np.linspace('a', 1)]": "E-RUN line 3: not a str",
}
CASES = SOURCES | {"import math, numpy as np\n" + phi_source(body): words for body, words in BODIES.items()}


@pytest.mark.parametrize("source", CASES)
def test_refusal_tells_what_to_change(source):
    start, words = CASES[source].split(": ")
    with pytest.raises(RefusedError) as refusal:
        read(source, 17, 6)
    assert str(refusal.value).startswith(f"{start}: ")
    assert words in str(refusal.value)
    for internal in ("lambda", "<locals>", "Symbol", "Bound", "lare_rl", "Operand"):
        assert internal not in str(refusal.value)


def test_refusal_lists_further_names():
    source = "import numpy as np\n" + phi_source("x = np.load('x')\ny = np.linalg.svdd(x)\nreturn [np.sqroot(y)]")
    with pytest.raises(RefusedError) as refusal:
        read(source, 17, 6)
    assert [line.split(":")[0] for line in str(refusal.value).split("\n")] == [f"E-NUMPY line {n}" for n in (3, 4, 5)]


ACCEPTED = set(
    "star_import type_call yield_function annotation_exec walrus_rebind_np np_frompyfunc np_apply_along_axis "
    "np_errstate_callback two_definitions lambda_called_at_once lambda_in_a_list module_as_value function_as_value method_as_value "
    "builtin_as_value inner_function_returned dunder_parameter dunder_loop_target comprehension_rebinds_np loop_rebinds_range "
    "with_two_contexts errstate_raise dtype_by_variable dtype_by_condition starred_subscript string_default_of_get "
    "einsum_pattern_by_key annotation_walrus annotation_lambda module_constant_appended import_swapped finfo_machar decorated "
    "round_to_minus_1e9_digits order_of_a_set_from_keys rare_order_of_a_set "
    # Their factors are not finite.
    "np_empty nan_division nan_log_negative inf_exp dtype_complex float_nan_string".split()
)
"""Hostile programs that are functions of a row when they are read: what would do harm is not carried out."""


@pytest.mark.parametrize("program", hostile_programs(), ids=lambda program: program.name)
def test_hostile_program(program):
    if program.name in ACCEPTED:
        assert set(read(program.source, *program.sizes).inputs) == {"observation", "action"}
    else:
        with pytest.raises(RefusedError):
            read(program.source, *program.sizes)
