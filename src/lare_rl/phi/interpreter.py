"""Carries out a program: a small, closed subset of Python, in which arrays are nodes of a graph.

Nothing of the source is compiled or executed. Each kind of statement (statements.py) and of expression (expressions.py) has
one rule, and all others are refused. A name is defined by the program or by `python_functions`. A function is defined by the
program, by `python_functions` or by `numpy_functions`. An attribute is in a table (attributes.py) or in a class of the
program (calls.py).

A program ends soon: the meter counts every step, and numbers, texts, lists and arrays are limited before they are made
(limits.py).
"""

from lare_rl.phi import attributes, calls, expressions, statements
from lare_rl.phi.builder import Builder
from lare_rl.phi.limits import MAX_STEPS
from lare_rl.phi.python_functions import BUILTINS
from lare_rl.phi.runtime import Meter, Runtime
from lare_rl.phi.values import Scope, Symbol

__all__ = ["Interpreter"]


class Interpreter(Runtime):
    """The state of a program that is carried out. Its methods are the functions of the modules that describe them."""

    def __init__(self, builder: Builder, max_steps: int = MAX_STEPS):
        self.builder, self.meter = builder, Meter(max_steps)
        self.line, self.call_depth = 1, 0
        self.module = Scope()
        self.module |= {"__name__": "phi", "np": Symbol("np"), "numpy": Symbol("np"), "math": Symbol("math")}
        self.module |= {name: Symbol(name) for name in (*BUILTINS, "staticmethod", "classmethod", "property")}

    run = statements.run_statements
    assign = statements.assign
    evaluate = expressions.evaluate
    attribute = attributes.get_attribute
    call = calls.call
    binary = expressions.apply_binary
    item = expressions.get_item
    items = expressions.list_items
    truth = expressions.test_truth
