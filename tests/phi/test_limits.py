"""Reading ends, whatever the text is: limits are checked before time or memory is spent."""

import threading

import pytest

from lare.phi.graph import Refused
from lare.phi.parse import LONGEST_SOURCE, parse
from lare.phi.read import read
from toys import phi

NUMPY = "import numpy as np\nimport math\nimport itertools\n"
ATTACKS = {
    "long": "x = 1\n" * LONGEST_SOURCE,
    "brackets": "(" * 9000 + ")" * 9000,
    "lists": "x = " + "[" * 4000 + "]" * 4000,
    "minus": "x = " + "-" * 19000 + "1",
    "not": "x = " + "not " * 4000 + "1",
    "sums": "x = " + "+".join(["1"] * 9000),
    "calls": "x = f" + "()" * 9000,
    "attributes": "x = f" + ".a" * 9000,
    "indices": "x = f" + "[0]" * 6000,
    "lambdas": "x = " + "lambda: " * 2000 + "1",
    "ifs": "x = " + "1 if 1 else " * 1500 + "1",
    "blocks": "".join(f"{' ' * i}if 1:\n" for i in range(150)) + " " * 150 + "x = 1",
    "f-strings": "x = " + "f'{" * 100 + "1" + "}'" * 100,
    "digits": "x = " + "9" * 19000,
    "hexadecimal": "x = 0x" + "f" * 19000,
    "power": "x = 9 ** 9 ** 9 ** 9",
    "shift": "x = 1 << (1 << 40)",
    "growing integer": "x = 3\nfor i in range(99):\n    x = x * x",
    "factorial": NUMPY + "x = math.factorial(10 ** 9)",
    "comb": NUMPY + "x = math.comb(10 ** 9, 10 ** 8)",
    "product": NUMPY + "x = math.prod(range(1, 9999))",
    "endless": "while True:\n    pass",
    "nested loops": "for a in range(999):\n    for b in range(999):\n        pass",
    "recursion": "def f():\n    return f()\nf()",
    "generator": "def f():\n    while True:\n        yield 1\nf()",
    "range": "x = list(range(10 ** 12))",
    "list product": "x = [0] * 10 ** 12",
    "text product": "x = 'a' * 10 ** 12",
    "text width": "x = f'{1:999999999}'",
    "text by percent": "x = '%999999999d' % 1",
    "text by format": "x = '{:999999999}'.format(1)",
    "text join": "x = ('a' * 9999).join(['b'] * 9999)",
    "text replace": "x = ('a' * 9999).replace('a', 'b' * 9999)",
    "text zfill": "x = 'a'.zfill(10 ** 12)",
    "doubling list": "s = []\nfor i in range(60):\n    s = [s, s]\nprint(s)",
    "doubling list compared": "s = []\nfor i in range(60):\n    s = [s, s]\nx = s == s",
    "doubling list as an array": NUMPY + "s = [1.0]\nfor i in range(60):\n    s = [s, s]\nx = np.array(s)",
    "doubling dictionary": "s = {}\nfor i in range(60):\n    s = {0: s, 1: s}\nx = str(s)",
    "doubling tuple as a key": "s = ()\nfor i in range(60):\n    s = (s, s)\nx = {s: 1}",
    "list in itself": "s = []\ns.append(s)\nprint(s)",
    "deep list": NUMPY + "s = 1.0\nfor i in range(5000):\n    s = [s]\nx = np.array(s)",
    "permutations": NUMPY + "x = list(itertools.permutations(range(99)))",
    "combinations": NUMPY + "x = list(itertools.combinations(range(99), 10 ** 9))",
    "cartesian": NUMPY + "x = list(itertools.product([1], repeat=10 ** 9))",
    "zeros": NUMPY + "x = np.zeros((10 ** 6, 10 ** 6))",
    "arange": NUMPY + "x = np.arange(10 ** 15)",
    "arange of small steps": NUMPY + "x = np.arange(0, 1, 1e-300)",
    "linspace": NUMPY + "x = np.linspace(0, 1, 10 ** 12)",
    "tile": NUMPY + "x = np.tile([1.0], (10 ** 6, 10 ** 6))",
    "repeat": NUMPY + "x = np.repeat([1.0], 10 ** 12)",
    "pad": NUMPY + "x = np.pad([1.0], 10 ** 12)",
    "broadcast": NUMPY + "x = np.zeros((9999, 1)) + np.zeros((1, 9999))",
    "broadcast_to": NUMPY + "x = np.broadcast_to(1.0, (10 ** 9, 10 ** 9))",
    "meshgrid": NUMPY + "x = np.meshgrid(*[np.arange(99)] * 9)",
    "fancy index": NUMPY + "x = np.eye(9)[np.zeros((9999, 1), int), np.zeros((1, 9999), int)]",
    "einsum": NUMPY + "x = np.einsum('a,b,c,d->', *[np.ones(999)] * 4)",
    "einsum of many letters": NUMPY + "x = np.einsum('abcdefghi,jklmnopqr->', *[np.ones((2,) * 9)] * 2)",
    "outer": NUMPY + "x = np.multiply.outer(np.ones(9999), np.ones(9999))",
    "windows": NUMPY + "x = np.lib.stride_tricks.sliding_window_view(np.ones(60000), 30000)",
    "tril_indices": NUMPY + "x = np.tril_indices(60000)",
    "bincount": NUMPY + "x = np.bincount([10 ** 12])",
    "vander": NUMPY + "x = np.vander(np.ones(999), 10 ** 9)",
    "roots": NUMPY + "x = np.roots(np.ones(9999))",
    "pinv": NUMPY + "x = np.linalg.pinv(np.ones((250, 250)))",
    "matrix_power": NUMPY + "x = np.linalg.matrix_power(np.eye(99), 10 ** 9)",
    "index arrays": NUMPY + "x = np.indices((10 ** 6, 10 ** 6))",
    "histogram": NUMPY + "x = np.histogram([1.0], bins=10 ** 12)",
    "many operations": NUMPY + "x = np.ones(9)\nfor i in range(30000):\n    x = np.sin(x)",
    "doubling array": NUMPY + "x = np.ones(9)\nfor i in range(99):\n    x = np.concatenate([x, x])",
    "many graph operations": phi("x = observation\nfor i in range(9999):\n    x = x * 1.1 + i\nreturn [x[:, :1]]"),
    "large graph": NUMPY + phi("x = np.repeat(observation, 3000, axis=1)\nreturn [(x * x).sum(axis=1, keepdims=True)]"),
    "doubling graph": phi("x = observation\nfor i in range(400):\n    x = x * x + x[:, ::-1]\nreturn [x[:, :1]]"),
    "polynomial": NUMPY + phi("return [np.polyval(np.ones(5000), observation[:, :1])]"),
    "quantiles": NUMPY + phi("return [np.quantile(observation, np.linspace(0, 1, 9999), axis=1)]"),
    # Found by a reviewer.
    "overflowing repetitions": NUMPY + "x = np.repeat(np.zeros(4), np.array([2 ** 62] * 4))",
    "negative payment": NUMPY + "itertools.repeat(0, -10 ** 15)\nwhile True:\n    pass",
    "raised doubling list": "s = []\nfor i in range(60):\n    s = [s, s]\nraise ValueError(s)",
    "sorted by doubling lists": "s = [1, 1]\nfor i in range(60):\n    s = [s, s]\nsorted([0, 1], key=lambda i: s)",
    "refusals within hasattr": NUMPY
    + "class A:\n    @property\n    def p(self):\n        return np.linalg.inv(np.eye(256))\n"
    + "for i in range(9999):\n    hasattr(A(), 'p')",
    "misspelled names": NUMPY + "for i in range(9999):\n    hasattr(np, 'linalgx')",
    "eigenvalues": NUMPY + "for i in range(99):\n    np.linalg.eigvalsh(np.eye(256))",
    "polynomials": NUMPY + "x = np.polymul(np.ones(30000), np.ones(30000))",
    "chebyshev": NUMPY + "x = np.polynomial.chebyshev.chebval(np.zeros(1), np.ones(60000))",
    "unravel": NUMPY + "x = np.unravel_index(3, [2 ** 62] * 9000)",
    "long keys": "t = (1,) * 9900\nfor i in range(9000):\n    {t}",
    "copied views": NUMPY
    + phi(
        "x = np.zeros((len(observation), 900))\nv = x[:, 9:]\nfor i in range(4000):\n    v.copy()\nreturn [v[:, :1]]"
    ),
    "text of rows": phi("return ['%999999999s' % len(observation)]"),
    "product of texts": NUMPY + "x = math.prod([10 ** 9], start='a')",
    "lists of arrays": NUMPY + "x = [np.zeros(60000).tolist() for i in range(3000)]",
    "long tuples": NUMPY + "x = list(itertools.product(*[[1]] * 1500, [0, 1], repeat=13))",
    "indices of a matrix": NUMPY + "x = np.tril_indices(2, 0, 500000000)",
    "covariance": NUMPY + "x = np.cov(np.zeros((1, 1)), np.zeros((15000, 1)))",
    "text of long texts": "s = ['a' * 9000] * 9000\nx = str(s)",
    "many letters": NUMPY + phi("return [np.einsum('b1->b', observation)]"),
    "letters that could be split": NUMPY + phi("return [np.einsum('aaaaaaaaaa,' * 40 + '1', observation)]"),
    "many axes": NUMPY + phi("return [np.sin(observation.reshape((-1,) + (1,) * 32 + (17,)))]"),
    "large product": NUMPY + phi("return [np.einsum('bi,bj,bk,bl->b', *[observation] * 4)[:, None]]"),
    "first row": NUMPY + phi("return [np.repeat(observation[0, 0][None, None], len(observation), axis=0)]"),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_is_refused(name):
    with pytest.raises(Refused) as refusal:
        read(ATTACKS[name], 17, 6)
    assert refusal.value.code not in ("E-BUG", "E-FORM")  # E-FORM: it ran to its end


@pytest.mark.parametrize("name", list(ATTACKS)[:16])
def test_parser_survives_in_a_thread_with_a_small_stack(name):
    refusals = []

    def attack():
        try:
            parse(ATTACKS[name])
        except Refused as refusal:
            refusals.append(refusal)

    before = threading.stack_size(256 << 10)
    try:
        thread = threading.Thread(target=attack)
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    assert threading.stack_size() == before


def test_refusal_cannot_be_caught():
    source = phi(
        "try:\n    x = observation.mean(axis=0)\nexcept Exception:\n    x = 0\nfinally:\n    return [action[:, :1]]"
    )
    with pytest.raises(Refused, match="E-ROWS"):
        read(source, 17, 6)


def test_program_sees_no_address():
    source = """import numpy as np

class A:
    pass

try:
    raise ValueError(np.zeros(3), A(), len, lambda: 0)
except ValueError as error:
    text = str(error)
assert "0x" not in text + str(A()) + str([A]) + repr(len) + f"{A}"

def evaluation_func(observation, action):
    return [action[:, :1]]
"""
    assert read(source, 17, 6).factor_count == 1
