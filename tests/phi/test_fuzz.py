"""Programs from a grammar, and mutations of real ones: they are refused, or agree with NumPy, row by row.

By hand with a larger budget: `LARE_FUZZ=20000 pytest tests/phi/test_fuzz.py`.
"""

import os
import random
import re
import warnings

import numpy as np
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from helpers.phi_programs import benign_programs, execute_program, hostile_programs, recorded_programs, varied_programs
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read
from phi.test_numpy_functions import CASES

EXAMPLES = int(os.environ.get("LARE_FUZZ", "150"))
BUDGET = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize="LARE_FUZZ" not in os.environ,
    suppress_health_check=list(HealthCheck),
)
LEAVES = "x|a|x[:, :3]|x[:, :1]|x[:, 0]|y|2|0.5|np.arange(3.0)|np.eye(3)|np.ones((len(x), 3))|x[0]|i|b".split("|")
TEMPLATES = [
    re.sub(r"\b[xnyt]\b", "{}", expression, count=2)
    for expressions in CASES.values()
    for expression in expressions
    if "lambda" not in expression and "{" not in expression
]
STATEMENTS = [
    "z = {}", "z = x.copy(); z[:, 0] = {}",
    "z = np.zeros((len(x), 3)); z[...] = {}", "z = x.copy(); z += {}", "z = x * 1; z[z < 0] = {}",
    "z = x.copy(); w = z[:, ::2]; w -= 1; z = z + {}", "z = x.copy(); z[np.arange(len(x)), np.argmax(x, axis=1)] = {}",
]  # fmt: skip
RESULTS = ["z", "z[:, :1]", "z.sum(axis=-1, keepdims=True)", "z[:, None]"]
RESULTS += ["np.sum(np.reshape(z, (len(x), -1)) * 1.0, axis=1, keepdims=True)"]


def fill(template, expressions):
    for expression in expressions:
        template = template.replace("{}", f"({expression})", 1)
    return template.replace("{}", "x")


EXPRESSIONS = st.recursive(
    st.sampled_from(LEAVES),
    lambda inner: st.builds(fill, st.sampled_from(TEMPLATES), st.lists(inner, min_size=2, max_size=2)),
    max_leaves=4,
)


@st.composite
def programs(draw):
    statement = fill(draw(st.sampled_from(STATEMENTS)), [draw(EXPRESSIONS)])
    setup = "x, a = observation, action; y = x.reshape(-1, 3, 2); b = x > 0.2; i = np.floor(np.abs(x) * 3).astype(int)"
    body = "\n    ".join([setup, *statement.split("; "), f"return [{draw(st.sampled_from(RESULTS))}]"])
    return f"import numpy as np\ndef evaluation_func(observation, action):\n    {body}\n"


def numpy_factors(source, observation, action):
    """The factors by NumPy, if it computes factors of independent rows; else None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            all_rows, first_rows = (execute_program(source, observation[:rows], action[:rows]) for rows in (7, 5))
    except Exception:  # whatever NumPy says of it
        return None
    same = (
        all_rows.shape == (7, 1)
        and first_rows.shape == (5, 1)
        and np.allclose(all_rows[:5], first_rows, equal_nan=True)
    )
    return all_rows if same else None


@BUDGET
@given(programs(), st.integers(0, 2**32 - 1))
def test_grammar_is_refused_or_agrees_with_numpy(source, seed):
    generator = np.random.default_rng(seed)
    observation, action = generator.standard_normal((7, 6)), generator.standard_normal((7, 3))
    try:
        graph = read(source, 6, 3)
    except RefusedError as refusal:
        assert refusal.code != "E-BUG", str(refusal)  # noqa: PT017
        event("refused")
        return
    expected = numpy_factors(source, observation, action)
    if expected is None:
        event("accepted, though NumPy raises an error")
        return
    event("accepted")
    factors = evaluate(graph, {"observation": observation, "action": action}, dtype=np.float64)["factors"]
    # NumPy computes functions of truth values in float16. The root of a rounding error is about 1e-8.
    np.testing.assert_allclose(factors, expected, rtol=1e-2 if "b" in source.split("int)")[1] else 1e-8, atol=1e-7)


SOURCES = [
    (p.source, p.sizes)
    for p in (*recorded_programs()[::9], *benign_programs(), *varied_programs()[::5], *hostile_programs())
]
WORDS = sorted({word for source, _ in SOURCES for word in re.findall(r"\w+|[^\w\s]", source)})


@st.composite
def mutants(draw):
    """A program with some of its words, lines or halves exchanged for those of others."""
    source, sizes = draw(st.sampled_from(SOURCES))
    chance = random.Random(draw(st.integers(0, 2**32)))
    lines = source.split("\n")
    for _ in range(chance.randint(1, 3)):
        line_index = chance.randrange(len(lines))
        other = chance.choice(SOURCES)[0].split("\n")
        match chance.randrange(4):
            case 0:
                lines.insert(line_index, chance.choice(other))
            case 1:
                lines = lines[:line_index] + other[chance.randrange(len(other)) :]
            case _:
                words = re.findall(r"\w+|\s+|[^\w\s]", lines[line_index]) or [""]
                words[chance.randrange(len(words))] = chance.choice(WORDS)
                lines[line_index] = "".join(words)
    return "\n".join(lines), sizes


@BUDGET
@given(mutants())
def test_mutant_is_refused_or_its_rows_are_independent(mutant):
    source, sizes = mutant
    try:
        graph = read(source, *sizes)
    except RefusedError as refusal:
        assert refusal.code != "E-BUG", str(refusal)  # noqa: PT017
        event("refused")
        return
    event("accepted")
    generator = np.random.default_rng(0)
    inputs = {
        key: generator.standard_normal((6, size)) for key, size in zip(("observation", "action"), sizes, strict=True)
    }
    factors = evaluate(graph, inputs, dtype=np.float64)["factors"]
    alone = evaluate(graph, {key: array[2:3] for key, array in inputs.items()}, dtype=np.float64)["factors"]
    np.testing.assert_allclose(alone[0], factors[2], rtol=1e-9, atol=1e-9)
