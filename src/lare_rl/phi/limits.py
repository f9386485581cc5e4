"""Every limit on a program and on its graph, and the error that a program gets when it is refused.

Each limit is checked before the time or the memory is spent. `Meter` (runtime.py) counts the steps of a program, `Builder`
(builder.py) the sizes of its arrays.
"""

from dataclasses import dataclass

# The text
MAX_SOURCE_LENGTH = 20_000  # characters
MAX_SYNTAX_DEPTH = 100  # levels of the syntax tree
PARSER_STACK_BYTES = 32 << 20  # of the thread in which Python's parser runs

# Running
MAX_STEPS = 40_000  # statements, expressions, and entries of lists that are created or read
MAX_CALL_DEPTH = 12
MAX_LIST_LENGTH = 10_000
MAX_TEXT_LENGTH = 10_000
MAX_KEY_LENGTH = 16  # entries of a tuple that is the key of a dictionary
MAX_INT_BITS = 63

# The result
MAX_FACTORS = 32
MAX_MESSAGES = 8  # about names that are not available, in one refusal
MAX_MESSAGE_LENGTH = 500

# Single functions of NumPy
MAX_CONSTANT_SIZE = 1024  # numbers in a constant that NumPy itself computes with, and the largest integer there
MAX_SYSTEM_SIZE = 64  # the same for functions that solve equations
MAX_TRANSFORM_LENGTH = 256
MAX_INVERSE_SIZE = 4  # rows of a matrix that is inverted
MAX_MATRIX_POWER = 64
MAX_EINSUM_ARRAYS = 8
MAX_EINSUM_LETTERS = 20

OPERATION_COST = 200
"""Work of an operation in addition to the numbers that it computes."""


@dataclass(frozen=True)
class GraphLimits:
    """Limits on a graph. They bound the time and the memory of everything that is computed from it."""

    array: int = 1 << 16
    """Numbers of one array, for each row."""
    axes: int = 16
    operations: int = 1000
    depth: int = 400
    """Operations that each need the result of the one before."""
    numbers: int = 1 << 15
    """Numbers of all results of a finished graph together, for each row."""
    work: int = 1 << 21
    """Numbers that are computed while a graph is built, for each row. Each operation counts as `OPERATION_COST` more."""


DEFAULT_LIMITS = GraphLimits()
UNLIMITED = GraphLimits(*[2**62] * 6)
"""For graphs that LaRe itself builds."""


class RefusedError(Exception):
    """A program is not accepted. The message tells its author what to change.

    Attributes:
        code: the rule, such as "E-ROWS".
        line: the line of the source, if it is known.
    """

    def __init__(self, code: str, message: str, line: int | None = None):
        super().__init__(message)
        self.code, self.line = code, line

    def located(self, line: int | None) -> str:
        """Return the message after its rule and a line of the source."""
        return f"{self.code} line {line}: {self}"
