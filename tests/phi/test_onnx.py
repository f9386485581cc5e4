"""The ONNX model of a graph gives the numbers of the graph."""

import numpy as np
import onnxruntime
import pytest

from helpers.long_tests import long_case
from helpers.phi_programs import benign_programs, random_inputs, recorded_programs, varied_programs
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.onnx import onnx_model
from lare_rl.phi.read import read
from phi.test_numpy_functions import CASES, SETUP

PROGRAMS = {p.name: p for p in (*benign_programs(), *varied_programs(), *recorded_programs())}
IN_SHORT = {*[p.name for p in varied_programs()[::12]], *[p.name for p in recorded_programs()[::80]]}
EXPRESSIONS = [case.values[0].replace("¦", "|") for case in CASES]


def check_same(graph, sizes):
    session = onnxruntime.InferenceSession(
        onnx_model(graph, "phi").SerializeToString(), providers=["CPUExecutionProvider"]
    )
    inputs = dict(zip(("observation", "action"), random_inputs(sizes, rows=7, dtype=np.float32), strict=True))
    (factors,) = session.run(["factors"], inputs)
    expected = evaluate(graph, inputs)["factors"]
    np.testing.assert_allclose(factors, expected, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("name", [name if name in IN_SHORT else long_case(name) for name in PROGRAMS])
def test_model_agrees_with_graph(name):
    program = PROGRAMS[name]
    try:
        graph = read(program.source, *program.sizes)
    except RefusedError:
        pytest.skip("it is refused")
    check_same(graph, program.sizes)


@pytest.mark.parametrize("expression", EXPRESSIONS[::3])
def test_function_can_be_written(expression):
    graph = read(SETUP.format(expression, 1).replace("np.arange(1, 1 + 1)", "1"), 6, 3)
    check_same(graph, (6, 3))
