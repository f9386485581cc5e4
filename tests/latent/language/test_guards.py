"""What can grow without a loop, and where it ends."""

import pytest

from lare.latent.language.guards import TooLarge
from programs import run


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("range(100_001)", "a sequence of 100001 entries"),
        ("sum(range(10 ** 12))", "a sequence of 1000000000000 entries"),
        ("list(range(0, -(10 ** 9), -2))", "a sequence of 500000000 entries"),
        ("[1, 2] * 5001", "a sequence of 2 entries, 5001 times"),
        ("5001 * (1, 2)", "a sequence of 2 entries, 5001 times"),
        ("[[1] * 10_000] * 10_001", "a sequence of 1 entries, 10001 times"),
        ("x = [1, 2]\nx *= 5001", "a sequence of 2 entries, 5001 times"),
        ("x = [[1, 2]]\nx[0] *= 5001", "a sequence of 2 entries, 5001 times"),
        ("for k in {'ab': 1}:\n    k * 5001", "a sequence of 2 entries, 5001 times"),
        ("2 ** 4097", "a power of integers"),
        ("2 ** 9 ** 9", "a power of integers"),
        ("x = 2\nx **= 4097", "a power of integers"),
        ("2 ** -4097", "a power of integers"),
        ("x = 2 ** 2000\nx * x * x", "a product of huge integers"),
        ("x = 2 ** 2000\nfor i in range(9): x *= x", "a product of huge integers"),
        ("np.prod([2 ** 2000] * 3000)", "an integer that no array holds"),
        ("np.array([[1, 2 ** 65]])", "an integer that no array holds"),
        ("np.clip(action, 0, max=2 ** 65)", "an integer that no array holds"),
        # What NumPy does one after the other, or reckons with before it looks
        ("np.diff(action, n=10 ** 12)", "a size above 1000"),
        ("np.diff(np.zeros(0), 10 ** 12)", "a size above 1000"),
        ("np.split(np.zeros(0), 10 ** 7)", "a size above 1000"),
        ("np.repeat(np.arange(4), 2 ** 62)", "a size above 33554432"),
        ("np.repeat(np.arange(4), [1, 2 ** 62, 1, 1])", "a size above 33554432"),
        ("np.repeat(np.arange(2), np.array([2 ** 62, 1]))", "a size above 33554432"),
        ("np.arange(4).repeat(2 ** 62)", "a size above 33554432"),
        ("np.tile(action, (1, 2 ** 62))", "a size above 33554432"),
        ("np.ones(180_000_000)", "a size above 33554432"),
        ("np.zeros(shape=(2, 10 ** 9))", "a size above 33554432"),
        ("np.broadcast_to(action[0], (10 ** 8, 6))", "a size above 33554432"),
        ("np.broadcast_to(action[0], (10 ** 7, 6))", "an array of 60000000 numbers"),
        ("np.ones((10 ** 4, 10 ** 4))", "an array of 100000000 numbers"),
        ("np.arange(5e7)", "an array of 50000000 numbers"),
        # What Python goes through at once
        ("list(np.zeros(3_000_000))", "a sequence of 3000000 entries"),
        ("a, *b = np.zeros(3_000_000)", "a sequence of 3000000 entries"),
        ("sorted(np.zeros(3_000_000))", "a sequence of 3000000 entries"),
        ("max(np.zeros(3_000_000))", "a sequence of 3000000 entries"),
        ("any(np.zeros(3_000_000))", "a sequence of 3000000 entries"),
        ("sum(np.zeros(3_000_000))", "a sequence of 3000000 entries"),
        *[
            (
                f"x = y = [1]\nfor i in range(60): x, y = [x, x], [y, y]\n{use}",
                "more than 50000 entries within each other",
            )
            for use in ("x == y", "x < y", "x in [y]", "1 < 2 < 3 != x", "np.array(x)", "max(x, y)", "sorted([x, y])")
        ],
        *[
            (f"x = ()\nfor i in range(5000): x = (((((x,),),),),)\n{use}", "lists are nested more than 32 deep")
            for use in (
                "{x: 1}",
                "{}[x]",
                "{}.get(x)",
                "{1: 2}.pop(x)",
                "x in {}",
                "{y: 1 for y in [x]}",
                "dict([(x, 1)])",
                "y = {}\ny[x] = 1",
                "y = {}\ny[1, x] = 1",
                "y = {1: 2}\ny[x] += 1",
            )
        ],
        ("x = [[1] * 10_000] * 10_000\nx == x", "more than 50000 entries within each other"),
    ],
)
def test_growth_without_a_loop_has_an_end(body, message):
    with pytest.raises(TooLarge) as error:
        run(body)
    assert str(error.value) == message


@pytest.mark.parametrize(
    "body",
    [
        "range(20_000)", "[1, 2] * 5000", "2 ** 2047", "x = 2 ** 1000\nx * x", "1.5 ** 500", "list(np.zeros(20_000))",
        "np.diff(action, n=5)", "np.ones((1000, 30_000))", "[[1, 2], [3]] == [(1,)]", "{(1, 2): 3}[1, 2]",
    ],
)  # fmt: skip
def test_growth_up_to_the_end(body):
    assert len(run(body)) == 1


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("np.ones((1, 1), int).dot([[2 ** 2000] * 3])", "arrays hold numbers only, not object"),
        (
            "[0] * (action.sum() > 1e20).astype(int)",
            "a list is repeated by a number of NumPy's: make it an array first",
        ),
        ("np.argmax(action) * (0, 1)", "a tuple is repeated by a number of NumPy's: make it an array first"),
    ],
)
def test_what_would_become_something_else(body, message):
    with pytest.raises(TypeError) as error:
        run(body)
    assert str(error.value) == message
