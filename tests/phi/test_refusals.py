"""What is refused, with the rule, the line, and the words that tell an author what to write instead."""

import pytest

from helpers.phi_programs import hostile_programs
from helpers.toy_envs import phi_source, toy_spec
from lare_rl.latent.verify import verify
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read

CASES = {
    "syntax": ("def f(:\n", "E-SYNTAX", "line 1"),
    "indent": ("def evaluation_func(o, a):\nreturn 1", "E-SYNTAX", "line 2"),
    "hidden character": ("x = 1  # \u202e", "E-SYNTAX", "no reader sees"),
    "line separator": ("x = 1  # \u2028import os", "E-SYNTAX", "no reader sees"),
    "null": ("x = 1\0", "E-SYNTAX", "no reader sees"),
    "no function": ("x = 1", "E-FORM", "evaluation_func"),
    "return at module level": ("return 1", "E-SYNTAX", "outside a function"),
    "import": ("import os\n" + phi_source("return [observation[:, :1]]"), "E-IMPORT", "numpy and math"),
    "relative import": ("from . import x\n" + phi_source("return [1]"), "E-IMPORT", "numpy and math"),
    "file": ("import numpy as np\n" + phi_source("return [np.load('x')]"), "E-NUMPY line 3", "no files"),
    "misspelled": ("import numpy as np\n" + phi_source("return [np.sqroot(observation)]"), "E-NUMPY line 3", "np.sqrt"),
    "chance": ("import numpy as np\n" + phi_source("return [np.random.rand(3)]"), "E-NUMPY line 3", "chance"),
    "argument": ("import numpy as np\n" + phi_source("return [np.sum(observation, axes=1)]"), "E-NUMPY line 3", "axis"),
    "missing argument": (
        "import numpy as np\n" + phi_source("return [np.partition(observation)]"),
        "E-NUMPY line 3",
        "kth",
    ),
    "unknown name": (phi_source("return [obs[:, :1]]"), "E-RUN line 2", "obs is not defined"),
    "eval": (phi_source("return [eval('1')]"), "E-RUN line 2", "eval is not defined"),
    "dunder": (phi_source("return [observation.__class__]"), "E-ATTRIBUTE line 2", "__class__"),
    "method": (phi_source("return [observation.normalize()]"), "E-ATTRIBUTE line 2", "function of NumPy"),
    "if on a row": (phi_source("if observation[0, 0] > 0:\n    pass\nreturn [1]"), "E-ROWS line 2", "one row for all"),
    "if on all rows": (
        phi_source("x = observation[:, 0]\nif (x > 0).all():\n    pass"),
        "E-ROWS line 3",
        "over the batch",
    ),
    "if on numbers": (phi_source("x = observation.sum(axis=1)\nif x > 0:\n    pass"), "E-FLOW line 3", "np.where"),
    "python max": (phi_source("return [max(observation[:, :1], 0)]"), "E-FLOW line 2", "np.maximum"),
    "math of an array": (
        "import math\n" + phi_source("return [math.sqrt(observation[:, :1])]"),
        "E-FLOW line 3",
        "np.sqrt",
    ),
    "float of an array": (phi_source("return [float(observation[:, 0])]"), "E-FLOW line 2", "astype"),
    "mean of the batch": (phi_source("return [observation - observation.mean(axis=0)]"), "E-ROWS line 2", "axis=1"),
    "sum without axis": (
        "import numpy as np\n" + phi_source("return [np.sum(observation)]"),
        "E-ROWS line 3",
        "axis=1",
    ),
    "loop over rows": (phi_source("for row in observation:\n    pass"), "E-ROWS line 2", "loop"),
    "range of rows": (phi_source("for i in range(len(observation)):\n    pass"), "E-ROWS line 2", "loop"),
    "batch as a number": (
        phi_source("return [observation[:, :1] / len(observation)]"),
        "E-ROWS line 2",
        "number of rows",
    ),
    "row against column": (phi_source("return [observation[:, :1] * action[:, 0]]"), "E-ROWS line 2", "[:, None]"),
    "order of rows": (phi_source("return [observation[::-1, :1]]"), "E-ROWS line 2", "x[:, i]"),
    "row number": (
        "import numpy as np\n" + phi_source("return [np.arange(len(action))[:, None] * 1.0]"),
        "E-ROWS line 3",
        "number of its row",
    ),
    "mix of rows": (
        "import numpy as np\n" + phi_source("return [observation @ observation.T]"),
        "E-ROWS line 3",
        "rows",
    ),
    "rows by einsum": (
        "import numpy as np\n" + phi_source("return [np.einsum('bi,ci->bc', action, action)]"),
        "E-ROWS line 3",
        "rows",
    ),
    "masked mean": (phi_source("return [observation[observation > 0].mean()]"), "E-ROWS line 2", "np.where"),
    "nonzero": (
        "import numpy as np\n" + phi_source("return [np.nonzero(observation)]"),
        "E-NUMPY line 3",
        "same for all rows",
    ),
    "entry that is not there": (phi_source("return [observation[:, 40]]"), "E-RUN line 2", "IndexError"),
    "slice that is not there": (phi_source("return [observation[:, 40:41]]"), "E-RUN line 2", "beyond the end"),
    "shapes": (phi_source("return [observation + action]"), "E-RUN line 2", "ValueError"),
    "input is written": (phi_source("observation[:, 0] = 1\nreturn [1]"), "E-RUN line 2", "copy"),
    "state": ("n = []\n" + phi_source("n.append(1)\nreturn [observation[:, :1] * len(n)]"), "E-STATE", "second call"),
    "raised": (phi_source("raise ValueError('no')"), "E-RUN line 2", "no"),
    "assertion": (phi_source("assert observation.shape[1] == 18, 'size'\nreturn [1]"), "E-RUN line 2", "size"),
    "async": ("async def f():\n    pass\n", "E-PYTHON line 1", "async"),
    "no list": (phi_source("return observation[:, :1]"), "E-FORM line 2", "list"),
    "one axis": (phi_source("return [observation[:, 0]]"), "E-FORM line 2", "[:, None]"),
    "two columns": (phi_source("return [observation[:, :2]]"), "E-FORM line 2", "(batch, 2)"),
    "constant": ("import numpy as np\n" + phi_source("return [np.zeros((5, 1))]"), "E-FORM line 3", "(5, 1)"),
    "no factors": (phi_source("return []"), "E-FORM line 2", "1 to 32"),
    "too many factors": (phi_source("return [observation[:, :1]] * 33"), "E-FORM line 2", "33"),
    "recursion": ("def f(x):\n    return f(x)\n" + phi_source("return [f(observation)]"), "E-COST", "calls"),
    "endless loop": (phi_source("while True:\n    pass"), "E-COST", "steps"),
    "large array": ("import numpy as np\n" + phi_source("return [np.zeros((1000, 1000))]"), "E-COST line 3", "1000000"),
    "4 x 4 eigenvalues": (
        "import numpy as np\n" + phi_source("return [np.linalg.eigvalsh(observation[:, :16].reshape(-1, 4, 4))]"),
        "E-NUMPY line 3",
        "3 x 3",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_refusal_tells_what_to_change(name):
    source, begin, words = CASES[name]
    with pytest.raises(RefusedError) as refusal:
        read(source, 17, 6)
    assert str(refusal.value).startswith(begin)
    assert words in str(refusal.value)


def test_refusal_lists_further_names():
    source = "import numpy as np\n" + phi_source("x = np.load('x')\ny = np.linalg.svdd(x)\nreturn [np.sqroot(y)]")
    with pytest.raises(RefusedError) as refusal:
        read(source, 17, 6)
    assert [line.split(":")[0] for line in str(refusal.value).split("\n")] == [f"E-NUMPY line {n}" for n in (3, 4, 5)]


def test_reward_must_be_single():
    verdict = verify(phi_source("return [action, action]"), toy_spec(), "reward")
    assert "exactly one" in verdict.errors


ACCEPTED = set(
    "star_import type_call yield_function try_swallow annotation_exec walrus_rebind_np np_frompyfunc np_apply_along_axis "
    "np_errstate_callback two_definitions lambda_called_at_once lambda_in_a_list module_as_value function_as_value method_as_value "
    "builtin_as_value inner_function_returned dunder_parameter dunder_loop_target comprehension_rebinds_np loop_rebinds_range "
    "with_two_contexts errstate_raise dtype_by_variable dtype_by_condition starred_subscript string_default_of_get "
    "einsum_pattern_by_key annotation_walrus annotation_lambda module_constant_appended import_swapped finfo_machar decorated "
    "list_times_numpy_integer round_to_minus_1e9_digits".split()
)
"""Hostile programs that are functions of a row when they are read: what would do harm is not carried out."""
NOT_FINITE = set("np_empty nan_division nan_log_negative inf_exp dtype_complex float_nan_string".split())
"""Those that can be read, but give factors that are not finite."""


@pytest.mark.parametrize("name", [program.name for program in hostile_programs()])
def test_hostile_program(name):
    program = next(p for p in hostile_programs() if p.name == name)
    if name in ACCEPTED | NOT_FINITE:
        graph = read(program.source, *program.sizes)
        assert set(graph.inputs) == {"observation", "action"}
    else:
        with pytest.raises(RefusedError):
            read(program.source, *program.sizes)
