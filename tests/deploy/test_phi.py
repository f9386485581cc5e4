"""`phi` as a graph: the same numbers as the program, by NumPy and by ONNX Runtime; or a word on what has no translation."""

import re
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

import lare
from lare.deploy import onnx
from lare.deploy.exported import OPERATIONS
from lare.deploy.graph import Graph
from lare.deploy.phi import factors
from lare.deploy.rows import FUNCTIONS, Rows, Untranslatable
from tiers import long

ENTRIES, ACTIONS = 6, 2


def graph_of(source, entries=ENTRIES, actions=ACTIONS):
    graph = Graph()
    observation = Rows(graph, graph.input("observation", (entries,)), (entries,))
    action = Rows(graph, graph.input("action", (actions,)), (actions,))
    found = factors(graph, source, observation, action)
    graph.output("factors", found.name, found.shape)
    return graph


def computed(graph, **inputs):
    """Both ways."""
    values = graph.constants | inputs
    for operation, arguments, result, axis in graph.operations:
        more = {} if axis is None else {"axis": axis}
        values[result] = OPERATIONS[operation](*(values[one] for one in arguments), **more)
    session = onnxruntime.InferenceSession(
        onnx.model(graph, "phi").SerializeToString(), providers=["CPUExecutionProvider"]
    )
    return values["factors"], session.run(None, inputs)[0]


def steps(entries=ENTRIES, actions=ACTIONS):
    random = np.random.default_rng(0)
    return (
        random.normal(size=(9, entries)).astype(np.float32),
        random.uniform(-1, 1, size=(9, actions)).astype(np.float32),
    )


def program(body):
    lines = "".join(f"    {line}\n" for line in body.split("\n"))
    return f"import numpy as np\n\ndef evaluation_func(o, a):\n{lines}"


TRANSLATED = [
    "return [o[:, 0:1] + 2, 1 - o[:, [1][0]:2], -a[:, 0:1] / (3 + o[:, 2:3] ** 2), 2.0 ** o[:, 3:4]]",
    "return [np.sum(o[:, ::2], axis=1, keepdims=True), np.mean(o, axis=-1)[:, None], o.max(axis=1)[:, np.newaxis]]",
    "return [np.min(np.abs(o), axis=1, keepdims=True), np.prod(o[:, -2:], axis=(1,), keepdims=True)]",
    "x = np.linalg.norm(o[:, :3], axis=1, keepdims=True)\n"
    "return [x, np.sqrt(np.square(x) + 1), np.exp(-x), np.log1p(x), np.log(x)]",
    "return [np.where(o[:, 0:1] > 0, o[:, 1:2], -1.0), np.where((o[:, 0:1] < 0) & (o[:, 1:2] >= 0), 2.0, np.tanh(a[:, 0:1]))]",
    "near = (np.abs(o) < 0.5).astype(float)\nreturn [np.sum(near, axis=1, keepdims=True), np.clip(o[:, 0:1], -0.5, None)]",
    "return [np.any(o > 1, axis=1, keepdims=True).astype(np.float32), np.all(~(o > 1) | (o < 2), axis=1)[:, None] * 1.0]",
    "n = o.shape[0]\np = o.reshape(n, 3, 2)\nd = np.sqrt(((p[:, :, None, :] - p[:, None, :, :]) ** 2).sum(axis=3))\n"
    "return [d.min(axis=2).max(axis=1, keepdims=True), np.argmax(d[:, 0], axis=1)[:, None] * 1.0]",
    "p = o.reshape(-1, 3, 2)\nq = np.concatenate([p, -p], axis=1)\ns = np.stack([o, 2 * o], axis=1)\n"
    "return [q.sum(axis=(1, 2))[:, None], s[:, 1, 3:4], np.stack([a[:, 0], a[:, 1]], axis=-1).sum(axis=1, keepdims=True)]",
    "w = np.array([1.0, 2.0, 3.0])\nw = w / w.sum()\nreturn [np.sum(o[:, :3] * w, axis=1, keepdims=True) * np.sqrt(2.0) * np.pi]",
    "total = np.zeros_like(o[:, 0:1])\nfor i in range(3):\n    total += (i + 1) * o[:, i:i + 1]\nreturn [total]",
    "found = []\nfor low, high in ((0, 2), (2, 4)):\n    found.append(np.sum(o[:, low:high], axis=1, keepdims=True))\nreturn found",
    "x, y = o[:, 0:1], o[:, 1:2]\nreturn [np.maximum(x, y), np.minimum(x, 0.0), np.sign(y), np.floor(x), np.cos(x) * np.sin(y)]",
    "def near(x, size=1.0):\n    return np.exp(-np.square(x) / size)\nreturn [near(o[:, 0:1]), near(o[:, 1:2], size=2.0)]",
    "return [o[:, i][:, None] for i in range(2)]",
    "t = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]])\nx = (o[:, 0:3] > 0) @ t\n"
    "return [x[:, 0:1], x[:, 1:2], (o[:, :3] @ t[:, 0])[:, None], np.dot(o[:, :3], [1.0, 2.0, 3.0])[:, None]]",
    "return [np.round(o[:, 0:1] * 4), np.around(o[:, 1:2], 2), o[:, 2:3].round(decimals=1), np.rint(a[:, 0:1])]",
    "weights = np.arange(6) + np.arange(1, 4, 0.5)\nreturn [np.sum(o * weights, axis=1, keepdims=True)]",
]


@pytest.mark.parametrize("body", TRANSLATED)
def test_a_translation_computes_the_same(body):
    source, (observation, action), names = program(body), steps(), {}
    exec(source, names)  # these programs are this file's own
    with np.errstate(all="ignore"):
        wanted = np.concatenate(names["evaluation_func"](observation.copy(), action.copy()), axis=1)
    for found in computed(graph_of(source), observation=observation, action=action):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("task", "draw"),
    [("HalfCheetah-v4", 1), long("HumanoidStandup-v4", 0), ("CN-6", 2), long("PP-6", 0), long("SMAX-2s3z", 0)],
)
def test_recorded_functions_have_a_translation(task, draw):
    """94 of 100 of them have (109 of 116)."""
    role = lare.load_task(task)
    phi = lare.design(role, draw=draw)
    observation, action = steps(role.observation_size, role.action_size)
    graph = graph_of(phi.source, role.observation_size, role.action_size)
    wanted = phi(observation, action)
    for found in computed(graph, observation=observation, action=action):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
    phi.close()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return [np.median(o, axis=1, keepdims=True)]", "a call of np.median"),
        ("return [o[:, 0:1] - np.mean(o[:, 0:1])]", "a reduction over all axes"),
        ("return [o[:, 0:1] - np.mean(o[:, 0:1], axis=0)]", "a reduction over the batch"),
        ("return [o[0:1, 0:1] + o[:, 0:1]]", "an index along the batch"),
        (
            "return [np.array([[1.0], [2.0], [3.0], [4.0]]) @ o[:, 0:1]]",
            r"a product \(@\) whose second part is computed",
        ),
        ("return [o @ np.array([[1.0], [2.0]])]", r"a product \(@\) that is not of a row and a table"),
        ("return [o[:, 0:1] % 2.0]", "the operator %"),
        ("return [o[:, 9:10]]", r"factors that are not \(batch, 1\)"),
        ("return [o[:, 9][:, None]]", "an index beyond the end"),
        ("return [o[:, 0]]", r"factors that are not \(batch, 1\)"),
        ("return [o[:, 0] + o[:, 0:1]]", "arrays with different numbers of axes"),
        ("return [o.reshape(2, -1)[:, 0:1]]", "a reshape of the batch"),
        ("return [o[:, 0:1] * np.zeros((9, 1))]", "np.zeros"),
        ("return [o[:, 0:1] * 2 ** 100]", "a large number"),
        ("return [np.sum(o * np.arange(10 ** 12), axis=1, keepdims=True)]", "a large constant"),
        ("return [o[:, 0:1] * np.arange(1, 2, 0)[0]]", "division by zero"),
        ("x = [0.0] * 10 ** 9\nreturn [o[:, 0:1]]", "a large constant"),
        ("x = 2 ** 64\nfor i in range(9):\n    x = x ** 9\nreturn [o[:, 0:1] + x]", "a large number"),
        (
            "x = np.array([1.0] * 2000)\ny = np.array([[1.0]] * 2000)\nreturn [o[:, 0:1] * np.sum(x * y)]",
            "a large constant",
        ),
        ("return [o[:, np.argmax(o, axis=1)]]", "an index that is neither a number nor a slice"),
        ("o[:, 0] = 1\nreturn [o[:, 0:1]]", "an assignment to a part of an array"),
        ("x = 0\nfor i in range(10 ** 9):\n    x = x + 1\nreturn [o[:, 0:1] + x]", "too long a program"),
        ("while True:\n    pass", "a statement: While"),
        ("if o.shape[0] > 3:\n    return [o[:, 0:1]]\nreturn [o[:, 1:2]]", "a statement: If"),
        ("return o", r"factors that are not \(batch, 1\)"),
        ("return [q]", "q"),
    ],
)
def test_what_has_no_translation_is_named(body, message):
    with pytest.raises(Untranslatable, match=message):
        graph_of(program(body))


def test_the_documentation_lists_the_functions():
    section = (Path(__file__).parents[2] / "docs" / "export.md").read_text().partition("these functions of NumPy")[2]
    listed = re.findall(r"`([\w.]+)`", section.partition("; and the methods")[0])
    assert listed == sorted(FUNCTIONS)


def test_a_source_that_was_not_checked_is_not_read():
    with pytest.raises(Untranslatable, match="a source that the gate has not passed"):
        graph_of("")
