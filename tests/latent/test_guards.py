"""What can grow without a loop, and where it ends."""

import pytest

from lare.latent.guards import TooLarge
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
    ],
)
def test_growth_without_a_loop_has_an_end(body, message):
    with pytest.raises(TooLarge) as error:
        run(body)
    assert str(error.value) == message


@pytest.mark.parametrize("body", ["range(20_000)", "[1, 2] * 5000", "2 ** 2047", "x = 2 ** 1000\nx * x", "1.5 ** 500"])
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
