"""The graph: kinds and shapes of operations, what factors read, and graphs within graphs."""

import numpy as np
import pytest

from helpers.phi_programs import Program, benign_programs, random_inputs, read_program, varied_programs
from helpers.toy_envs import phi_source
from lare_rl.latent.function import features_text
from lare_rl.phi.arrays import Array
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import UNLIMITED, GraphLimits, RefusedError
from lare_rl.phi.read import apply_program, read

PROGRAMS = {p.name: p for p in (*benign_programs()[:6], *varied_programs()[5::20])}


@pytest.mark.parametrize(
    ("op", "kinds", "result"),
    [
        ("add", ("bool", "bool"), "bool"),
        ("add", ("int", "float"), "float"),
        ("divide", ("int", "int"), "float"),
        ("less", ("float", "int"), "bool"),
        ("fmax", ("bool", "bool"), "bool"),
        ("bitwise_and", ("bool", "bool"), "bool"),
        ("floor_divide", ("bool", "bool"), "int"),
    ],
)
def test_kind_is_that_of_numpy(op, kinds, result):
    builder = Builder()
    inputs = [builder.input(f"x{i}", (2,), kind) for i, kind in enumerate(kinds)]
    assert builder.nodes[builder.elementwise(op, *inputs)].kind == result


def test_rearrangements_of_rearrangements_are_one_gather():
    graph = read(phi_source("return [observation.reshape(-1, 2, 3).transpose(0, 2, 1)[:, 1, ::-1][:, :1]]"), 6, 1)
    assert [node.op for node in graph.operations] == ["gather"]
    assert graph.operations[0].option.slices == (slice(4, 5, 1),)


@pytest.mark.parametrize("limit", [{"array": 4}, {"operations": 3}, {"depth": 3}, {"work": 999}, {"numbers": 5}])
def test_limit_is_checked(limit):
    builder = Builder(GraphLimits(**limit))

    def build():
        x = builder.input("x", (5,))
        for _ in range(9):
            x = builder.elementwise("sin", x)
        builder.finish({"y": x})

    with pytest.raises(RefusedError, match=r"at most|too much"):
        build()


@pytest.mark.parametrize("name", PROGRAMS)
def test_entries_that_are_not_read_do_not_matter(name):
    program = PROGRAMS[name]
    graph = read_program(program)
    observation, action = random_inputs(program.sizes, rows=5)
    factors = evaluate(graph, {"observation": observation, "action": action}, dtype=np.float64)["factors"]
    for number, entries in enumerate(graph.entries_read("factors")):
        changed = {}
        for key, array in (("observation", observation), ("action", action)):
            unread = np.setdiff1d(np.arange(array.shape[1]), entries[key])
            changed[key] = array.copy()
            changed[key][:, unread] = 7.3 - 2 * array[:, unread]
        result = evaluate(graph, changed, dtype=np.float64)["factors"]
        np.testing.assert_array_equal(result[:, number], factors[:, number])


def test_entries_read_are_exact_through_whole_arrays():
    source = "import numpy as np\n" + phi_source(
        "x = np.tanh(observation * 2)\nsorted_x = np.sort(x[:, 4:], axis=1)\n"
        "return [x[:, 2:3] + x[:, 5:6], sorted_x[:, :1] * action, np.where(x > 0, x, 1)[:, [0]]]"
    )
    texts = [features_text(entries) for entries in read(source, 7, 1).entries_read("factors")]
    assert texts == ["observation[2, 5]", "observation[4:7], action[0]", "observation[0]"]


@pytest.mark.parametrize(
    "expression",
    [
        "y @ np.array([1.0, 2.0])",
        "y @ np.array([[2.0, -1.0], [1.0, 3.0]])",
        "np.einsum('bij,bij->bi', y, y)",
        "np.einsum('bii->bi', y[:, :2])",
        "np.einsum('bii->b', y[:, 1:])",
        "np.einsum('...i,...i->...', y, y[:, :1])",
        "np.einsum('...ij,...kj->...ik', z, z)",
        "np.einsum('b...,...->b', x[:, :3], 3 * np.ones(3)) * np.einsum('b,->b', x[:, 8], 2.0)",
        "np.linalg.det(z)",
        "np.cumsum(x, axis=1)",
        "np.cumprod(z, axis=-2)",
        "np.cumsum(z, axis=1)",
    ],
)
def test_entries_read_are_those_whose_change_matters(expression):
    source = "import numpy as np\n" + phi_source(
        f"x = observation\ny = x[:, :6].reshape(-1, 3, 2)\nz = x.reshape(-1, 3, 2, 2)\n"
        f"w = ({expression}).reshape(len(x), -1)\nreturn [w[:, i : i + 1] for i in range(w.shape[1])]"
    )
    graph = read(source, 12, 1)
    observation, action = random_inputs((12, 1), rows=9)
    changed = np.repeat(observation[None], 12, axis=0)
    changed[np.arange(12), :, np.arange(12)] += 0.7
    rows = {"observation": observation, "action": action}
    rows_changed = {"observation": changed, "action": np.repeat(action[None], 12, axis=0)}
    before, after = (evaluate(graph, x, dtype=np.float64)["factors"] for x in (rows, rows_changed))
    matters = np.any(np.abs(after - before) > 1e-9, axis=1)
    entries = [entries["observation"] for entries in graph.entries_read("factors")]
    assert entries == [np.flatnonzero(column).tolist() for column in matters.T]


ROWS = "import numpy as np\n" + phi_source(
    "x = observation\ny = x[np.arange(len(x)), np.argmax(x[:, :3], axis=1)]\nz = np.apply_along_axis(np.sort, 1, x[:, :3])\n"
    "t = np.tile(np.arange(3.0), (len(x), 1))[np.arange(x.shape[0])[:, None], [[0, 2]]]\nreturn [y[:, None], z[:, :1], t[:, 1:]]"
)


@pytest.mark.parametrize("name", [*PROGRAMS, "rows"])
def test_program_applied_to_several_rows(name):
    program = PROGRAMS.get(name, Program(name, (7, 2), ROWS))
    graph = read_program(program)
    observation, action = (array.reshape(4, 3, -1) for array in random_inputs(program.sizes, rows=12))
    arrays = {"observation": observation, "action": action}
    with building(Builder(UNLIMITED)) as builder:
        inputs = [Array(builder.input(key, array.shape[1:]), 0) for key, array in arrays.items()]
        outer = builder.finish({"factors": apply_program(program.source, *inputs).node})
    for_rows = evaluate(outer, arrays, dtype=np.float64)["factors"]
    np.testing.assert_allclose(for_rows, evaluate(graph, arrays, dtype=np.float64)["factors"], rtol=1e-12, atol=1e-12)
