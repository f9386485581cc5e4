"""Programs by chance, from the language's own grammar: one that is proved keeps its promise.

A small budget here; by hand a large one, as `LARE_FUZZ=20000 pytest tests/latent/test_fuzz.py`.
"""

import os

import numpy as np
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from lare.latent.language.gate import inspect
from lare.latent.language.program import Program
from lare.latent.verification.rows import FUNCTIONS, check_own, labelled
from toys import phi

ROWS = 6

LEAVES = [
    *(
        "action",
        "x",
        "z",
        "observation[:, 2:8]",
        "(action * 2)",
        "z",
        "action[:, :1]",
        "np.ones((len(action), 1))",
        "np.float64(0.5)",
    ),
    *("np.arange(len(action))[:, None]", "np.zeros_like(action)", "observation.T", "action[0]", "np.arange(6.0)"),
]
AXES = st.sampled_from(["0", "1", "-1", "None"])
MOVES = [
    "{}.T", "{}[::-1]", "{}[:, :1]", "{}[:, None]", "{}[1:]", "{}.reshape(len(action), -1)", "{}.reshape(-1, 1)", "np.squeeze({})",
    "{}.ravel()", "{}.copy()", "{}[np.arange(len(action)), 0]", "{}.astype(float)", "np.atleast_2d({})", "np.tile({}, (1, 2))",
]  # fmt: skip


def names(text: str) -> st.SearchStrategy[str]:
    return st.sampled_from(text.split())


def larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    """Expressions of smaller ones."""
    both = st.tuples(inner, inner)
    return st.one_of(
        st.builds("np.{}({})".format, names("tanh abs sign square isfinite"), inner),
        st.builds(lambda operator, pair: f"({pair[0]} {operator} {pair[1]})", names("+ - * / @ > =="), both),
        st.builds(
            "np.{}({}, axis={}, keepdims=True)".format, names("sum mean max min std argmax median any"), inner, AXES
        ),
        st.builds("{}.{}(axis={})".format, inner, names("sum max mean"), AXES),
        st.builds("np.{}({}, axis={})".format, names("cumsum sort diff flip"), inner, AXES),
        st.builds("np.roll({}, {}, axis={})".format, inner, names("1 2 -1"), AXES),
        st.builds(lambda pair, axis: f"np.concatenate([{pair[0]}, {pair[1]}], axis={axis})", both, AXES),
        st.builds(lambda pair, axis: f"np.stack([{pair[0]}, {pair[1]}], axis={axis})", both, AXES),
        st.builds(lambda pair: f"np.where({pair[0]} > 0, {pair[0]}, {pair[1]})", both),
        st.builds(lambda pair: f"np.einsum('ij,ij->i', {pair[0]}, {pair[1]})", both),
        st.builds("np.take_along_axis({0}, np.argmax({0}, axis=1)[:, None], axis=1)".format, inner),
        st.builds(str.format, st.sampled_from(MOVES), inner),
    )


EXPRESSIONS = st.recursive(st.sampled_from(LEAVES), larger, max_leaves=3)
STORES = st.sampled_from(
    [
        "z[:, :1] = {}",
        "z[...] = {}",
        "z += {}",
        "z[0] = {}",
        "z[:, 1] = {}",
        "z = z + {}",
        "np.add(z, {}, out=z)",
        "w = z[1:]\nw += {}",
    ]
)


@st.composite
def programs(draw) -> str:
    first, stored, last = draw(EXPRESSIONS), draw(EXPRESSIONS), draw(EXPRESSIONS)
    store = draw(STORES).format(stored)
    lines = ["x = action", "z = np.zeros((len(action), 6))", f"x = {first}", store]
    turned = draw(
        st.sampled_from(["({})[:, :1]", "np.sum({}, axis=1, keepdims=True)", "({}).reshape(-1, 1)", "({} + z)[:, :1]"])
    )
    return phi("\n".join([*lines, f"return [{turned.format(last)}]"]))


def batch(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return random.standard_normal((ROWS, 17)).astype(np.float32), random.uniform(-1, 1, (ROWS, 6)).astype(np.float32)


def is_proved(source: str, inputs: tuple[np.ndarray, np.ndarray]) -> bool:
    try:
        found = Program(source, FUNCTIONS)(*map(labelled, inputs))
        if found[0].shape != (ROWS, 1):
            return False
        check_own(found, ROWS)
    except Exception:  # refused, for whatever reason
        return False
    return True


@settings(
    max_examples=int(os.environ.get("LARE_FUZZ", "150")),
    deadline=None,
    derandomize="LARE_FUZZ" not in os.environ,
    suppress_health_check=list(HealthCheck),
)
@given(programs(), st.integers(0, 2**32 - 1))
def test_what_is_proved_does_not_touch_other_rows(source, seed):
    assert inspect(source) == []
    random = np.random.default_rng(seed)
    ours, theirs = batch(random), batch(random)
    with np.errstate(all="ignore"):
        if not is_proved(source, ours):
            event("refused")
            return
        event("proved")
        program = Program(source)
        kept = random.random(ROWS) < 0.5
        changed = [np.where(kept[:, None], one, 30 * other) for one, other in zip(ours, theirs, strict=True)]
        expected, found = np.asarray(program(*ours)[0]), np.asarray(program(*changed)[0])
    np.testing.assert_allclose(found[kept], expected[kept], rtol=1e-5, atol=1e-6)
