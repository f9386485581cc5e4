"""The language of generated code: a small, closed subset of Python and NumPy.

These lists contain everything that is allowed. Anything else is refused, so that additions of new versions of Python and NumPy
are refused until they have been reviewed. The functions are pure and total, and the shapes of their results never depend on
values. `gate` checks a program against these lists; `program` binds the names to their functions.
"""

import re
from typing import NamedTuple

NAME = "evaluation_func"
"""The name that a reply must give its function."""

MODULES = {"np": "numpy", "numpy": "numpy", "math": "math"}
"""Names that are allowed only before a dot, and their modules."""


class Signature(NamedTuple):
    """How a function may be called."""

    least: int
    most: int
    """The most positional arguments. `out` and strings, which would come after them, are only allowed as keywords."""
    keywords: frozenset[str] = frozenset()
    dtype_at: int | None = None
    """The position at which a dtype is allowed."""


def signatures(names: str, least: int, most: int, keywords: str = "", dtype_at: int | None = None) -> dict:
    one = Signature(least, most, frozenset(keywords.split()), dtype_at)
    return dict.fromkeys(names.split(), one)


NUMPY: dict[str, Signature] = {
    # Element by element
    **signatures(
        "abs absolute arccos arccosh arcsin arcsinh arctan arctanh cbrt ceil cos cosh deg2rad degrees exp exp2 expm1 fabs "
        "floor invert isfinite isinf isnan log log10 log1p log2 logical_not negative positive rad2deg radians reciprocal "
        "rint sign signbit sin sinh sqrt square tan tanh trunc",
        1, 1, "out where dtype",
    ),
    **signatures(
        "add arctan2 copysign divide equal float_power floor_divide fmax fmin fmod greater greater_equal heaviside hypot "
        "less less_equal logaddexp logical_and logical_or logical_xor matmul maximum minimum mod multiply not_equal power "
        "remainder subtract true_divide",
        2, 2, "out where dtype",
    ),
    **signatures("clip", 1, 3, "a_min a_max min max"),
    **signatures("where", 3, 3),
    **signatures("nan_to_num", 1, 1, "nan posinf neginf"),
    **signatures("around round", 1, 2, "decimals"),
    **signatures("isclose", 2, 4, "rtol atol equal_nan"),
    **signatures("interp", 3, 3, "left right period"),
    **signatures("select", 2, 3, "default"),
    **signatures("sinc", 1, 1),
    **signatures("unwrap", 1, 1, "axis discont period"),
    # Along axes
    **signatures("sum prod mean max min amax amin", 1, 2, "axis keepdims dtype initial where"),
    **signatures("all any nanmax nanmean nanmin nansum", 1, 2, "axis keepdims where"),
    **signatures("std var", 1, 2, "axis keepdims dtype ddof"),
    **signatures("median ptp", 1, 2, "axis keepdims"),
    **signatures("average", 1, 2, "axis weights keepdims"),
    **signatures("percentile quantile", 2, 3, "axis keepdims method"),
    **signatures("argmax argmin", 1, 2, "axis keepdims"),
    **signatures("cumsum cumprod", 1, 2, "axis dtype"),
    **signatures("sort", 1, 2, "axis"),
    **signatures(
        "add.reduce multiply.reduce maximum.reduce minimum.reduce logical_and.reduce logical_or.reduce",
        1, 2, "axis keepdims dtype initial",
    ),
    **signatures("diff", 1, 2, "n axis prepend append"),
    **signatures("linalg.norm", 1, 3, "ord axis keepdims"),
    # Products
    **signatures("dot inner outer vdot", 2, 2),
    **signatures("cross", 2, 2, "axis"),
    **signatures("tensordot", 2, 3, "axes"),
    **signatures("einsum", 2, 8),
    **signatures("linalg.det", 1, 1),
    # New arrays
    **signatures("array asarray", 1, 2, "dtype ndmin copy", dtype_at=1),
    **signatures("zeros ones", 1, 2, "shape dtype", dtype_at=1),
    **signatures("zeros_like ones_like", 1, 2, "dtype shape", dtype_at=1),
    **signatures("full", 2, 3, "fill_value dtype shape", dtype_at=2),
    **signatures("full_like", 2, 3, "fill_value dtype shape", dtype_at=2),
    **signatures("arange", 1, 3, "dtype"),
    **signatures("linspace", 2, 3, "num endpoint dtype"),
    **signatures("eye", 1, 3, "N M k dtype"),
    **signatures("identity", 1, 1, "dtype"),
    **signatures("copy", 1, 1),
    # Shapes
    **signatures("atleast_1d atleast_2d", 1, 8),
    **signatures("broadcast_to", 2, 2),
    **signatures("column_stack dstack hstack vstack", 1, 1),
    **signatures("concatenate stack", 1, 2, "axis dtype"),
    **signatures("expand_dims flip squeeze split", 1, 3, "axis indices_or_sections"),
    **signatures("moveaxis", 3, 3),
    **signatures("pad", 2, 3, "pad_width mode constant_values"),
    **signatures("ravel ndim shape", 1, 1),
    **signatures("size", 1, 2),
    **signatures("repeat", 2, 3, "axis"),
    **signatures("reshape", 2, 2),
    **signatures("roll", 2, 3, "shift axis"),
    **signatures("swapaxes", 3, 3),
    **signatures("take take_along_axis", 2, 3, "axis"),
    **signatures("tile", 2, 2),
    **signatures("transpose", 1, 2, "axes"),
    **signatures("tril triu", 1, 2, "k"),
    # About numbers
    **signatures("finfo", 1, 1),
    **signatures("bool_ float32 float64 int32 int64", 1, 1),
}  # fmt: skip

NUMPY_CONSTANTS = frozenset("e inf newaxis pi".split())
DTYPES = frozenset("bool_ float32 float64 int32 int64".split())
DTYPE_NAMES = frozenset("bool float int float32 float64 int32 int64 f4 f8 i4 i8 single double".split())
"""Strings that may stand for a dtype."""

MATH: dict[str, Signature] = {
    **signatures(
        "acos acosh asin asinh atan atanh ceil cos cosh degrees exp fabs floor isfinite isnan log10 log1p log2 radians sin "
        "sinh sqrt tan tanh trunc",
        1, 1,
    ),
    **signatures("atan2 copysign fmod", 2, 2),
    **signatures("hypot", 1, 8),
    **signatures("log", 1, 2),
}  # fmt: skip
MATH_CONSTANTS = frozenset("e inf pi tau".split())

DOTTED: dict[str, Signature] = {f"numpy.{name}": one for name, one in NUMPY.items()} | {
    f"math.{name}": one for name, one in MATH.items()
}
CONSTANTS = frozenset(
    {f"numpy.{name}" for name in NUMPY_CONSTANTS | DTYPES} | {f"math.{name}" for name in MATH_CONSTANTS}
)

METHODS: dict[str, Signature] = {
    # of arrays
    **signatures("sum prod", 0, 1, "axis keepdims dtype initial where"),
    **signatures("mean", 0, 1, "axis keepdims dtype where"),
    **signatures("max min", 0, 1, "axis keepdims initial where"),
    **signatures("all any", 0, 1, "axis keepdims"),
    **signatures("std var", 0, 1, "axis keepdims dtype ddof"),
    **signatures("argmax argmin", 0, 1, "axis keepdims"),
    **signatures("cumsum cumprod", 0, 1, "axis dtype"),
    **signatures("astype", 1, 1, "dtype copy", dtype_at=0),
    **signatures("clip", 0, 2, "min max"),
    **signatures("round", 0, 1, "decimals"),
    **signatures("flatten ravel", 0, 0),
    **signatures("dot", 1, 1),
    **signatures("repeat", 1, 2, "axis"),
    **signatures("reshape", 1, 8),
    **signatures("squeeze", 0, 1, "axis"),
    **signatures("swapaxes", 2, 2),
    **signatures("take", 1, 2, "axis"),
    **signatures("transpose", 0, 8),
    # of arrays, lists and dictionaries
    **signatures("copy", 0, 0),
    **signatures("append extend", 1, 1),
    **signatures("insert", 2, 2),
    **signatures("pop", 0, 1),
    **signatures("get", 1, 2),
    **signatures("items keys values", 0, 0),
}

CHANGING = frozenset("append extend insert pop".split())
"""Methods that change the object that they are called on."""

ATTRIBUTES = frozenset("T dtype eps ndim resolution shape size tiny".split())
"""Attributes that may be read; of `np.finfo(...)` also max and min."""

BUILTINS: dict[str, Signature] = {
    **signatures("abs all any bool float int len list reversed sorted tuple", 1, 1),
    **signatures("dict", 0, 1),
    **signatures("enumerate", 1, 2, "start"),
    **signatures("max min", 1, 16),
    **signatures("range slice", 1, 3),
    **signatures("round", 1, 2),
    **signatures("sum", 1, 2, "start"),
    **signatures("zip", 1, 16, "strict"),
}

SHAPING = {
    **dict.fromkeys("zeros ones full identity".split(), (0,)),
    **dict.fromkeys("tile reshape broadcast_to pad".split(), (1,)),
    **dict.fromkeys("repeat split".split(), (1, 2)),
    "arange": (0, 1, 2),
    "linspace": (2,),
    "eye": (0, 1, 2),
    **dict.fromkeys("all any amax amin argmax argmin average cumprod cumsum max mean median min nanmax".split(), (1,)),
    **dict.fromkeys("nanmean nanmin nansum prod ptp sort std sum var".split(), (1,)),
    **{f"{name}.reduce": (1,) for name in "add multiply maximum minimum logical_and logical_or".split()},
    **dict.fromkeys("concatenate diff stack transpose tril triu".split(), (1,)),
    **dict.fromkeys("expand_dims flip squeeze moveaxis swapaxes roll linalg.norm".split(), (1, 2)),
    **dict.fromkeys("percentile quantile take take_along_axis tensordot".split(), (2,)),
}
"""For each function of NumPy, the positions of the arguments that determine the shape of the result or the axis."""

SHAPING_METHODS = {
    **dict.fromkeys("all any argmax argmin cumprod cumsum max mean min prod squeeze std sum var".split(), (0,)),
    **dict.fromkeys("reshape transpose".split(), tuple(range(8))),
    **dict.fromkeys("repeat swapaxes".split(), (0, 1)),
    "take": (1,),
}
SIZES = frozenset("shape num N M k repeats indices_or_sections pad_width axis axes keepdims n ndmin ord shift".split())
"""Keywords that determine the shape of a result or the axis."""

FUTURE = frozenset("absolute_import annotations division print_function unicode_literals".split())
"""Features of `__future__` that may be imported: they change nothing in a program."""

TYPING = frozenset("Any Dict Iterable List NamedTuple Optional Sequence Tuple Union".split())

KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_ -]{0,63}")
"""The strings that a program may contain: plain words, no format strings."""

AXES = r"[a-zA-Z]{0,8}(\.\.\.[a-zA-Z]{0,8})?"
EINSUM = re.compile(rf"{AXES}(,{AXES}){{0,7}}(->{AXES})?")

STRINGS = {
    "mode": frozenset("constant edge reflect symmetric wrap".split()),
    "method": frozenset("linear lower higher midpoint nearest".split()),
}
"""Keywords whose value is a string, and the allowed strings."""

FILES = "it reads or writes files"
CHANCE = "it depends on chance"
MEMORY = "it returns memory that nobody has written"
VALUES = "the shape of its result depends on values"
CALLBACK = "it calls Python for each element"

REASONS = {
    **dict.fromkeys("load save savez savez_compressed loadtxt savetxt genfromtxt fromfile memmap open_memmap".split(), FILES),
    **dict.fromkeys("random".split(), CHANCE),
    **dict.fromkeys("empty empty_like".split(), MEMORY),
    "ndarray": "np.array, np.asarray and np.zeros make arrays, and whatever is given is one",
    **dict.fromkeys("unique nonzero argwhere flatnonzero extract compress trim_zeros union1d".split(), VALUES),
    **dict.fromkeys("vectorize frompyfunc apply_along_axis apply_over_axes fromfunction piecewise".split(), CALLBACK),
}  # fmt: skip
"""The reasons why some existing NumPy functions are not allowed."""

INSTEAD = {
    "numpy.clamp": "np.clip",
    "numpy.linalg.inv": "np.linalg.norm and explicit formulas",
    "numpy.vectorize": "array operations",
    "numpy.piecewise": "np.select or np.where",
    "numpy.nonzero": "np.where with three arguments",
    "numpy.sigmoid": "1 / (1 + np.exp(-np.clip(x, -50, 50)))",
    "numpy.relu": "np.maximum(x, 0)",
    "numpy.softmax": "np.exp(x - x.max(axis=1, keepdims=True)), divided by its sum",
    "numpy.empty": "np.zeros",
    "numpy.empty_like": "np.zeros_like",
    "numpy.add.accumulate": "np.cumsum",
    "numpy.add.at": "the operator +=",
    "numpy.allclose": "np.isclose and np.all",
    "numpy.bool": "np.bool_",
    "numpy.count_nonzero": "np.sum of a condition",
    "numpy.emath.sqrt": "np.sqrt(np.maximum(x, 0))",
    "numpy.gradient": "np.diff",
    "numpy.nanstd": "np.std",
    "numpy.nanvar": "np.var",
    "numpy.trapezoid": "np.sum",
    "math.dist": "np.linalg.norm of the difference",
    "math.fsum": "np.sum",
    "math.isclose": "np.isclose",
    "math.pow": "the operator **",
    "math.prod": "np.prod",
    "pow": "the operator **",
    "print": "nothing: the function only returns its factors",
    "isinstance": "the shapes that are given: two arrays of two dimensions",
    "map": "a list comprehension",
    "filter": "np.where with three arguments",
}
"""What to write instead of a function that is not available."""
