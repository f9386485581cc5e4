"""Checks the expressions of a program, and records names, numbers, strings, calls and operators that are not in the language."""

import ast
import difflib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from lare.latent.language.allowed import (
    ATTRIBUTES,
    BUILTINS,
    CHANGING,
    CONSTANTS,
    DOTTED,
    DTYPE_NAMES,
    DTYPES,
    EINSUM,
    INSTEAD,
    METHODS,
    MODULES,
    NAME,
    REASONS,
    STRINGS,
    Signature,
)
from lare.latent.language.syntax import Function, dotted, exists, is_key, is_singleton, is_string, shown

LARGEST = 2**63
"""The largest integer that a program may contain."""

HUGE = "an integer is larger than 2**63"


MOST_HINTS, LONGEST_HINTED = 10, 40
"""The search for the intended name takes time. It is limited to this many problems, and to names of this many letters."""


class Problem(NamedTuple):
    """Something that a program must not contain."""

    code: str
    line: int
    message: str

    def __str__(self) -> str:
        return f"{self.code} line {self.line}: {self.message}"


OPERATORS = (
    *(ast.Add, ast.Sub, ast.Mult, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow, ast.MatMult),
    *(ast.BitAnd, ast.BitOr, ast.BitXor, ast.UAdd, ast.USub, ast.Not, ast.Invert),
)


@dataclass(frozen=True)
class Scope:
    """A function, or the module, and the names that are bound in it."""

    names: set[str]
    inputs: frozenset[str] = frozenset()
    """Names that still refer to the function's inputs, which must not be written to."""


@dataclass
class Expressions(ast.NodeVisitor):
    """Visits expressions and records what is not in the language. There is one method for each allowed node."""

    defined: list[tuple[str, Function]]
    problems: list[Problem] = field(default_factory=list)
    scopes: list[Scope] = field(default_factory=list)
    approved: set[ast.AST] = field(default_factory=set)
    """Strings and lambdas at places where they are allowed."""

    @property
    def functions(self) -> frozenset[str]:
        return frozenset(name for name, _ in self.defined)

    def refuse(self, code: str, node: ast.AST, message: str) -> None:
        self.problems.append(Problem(code, getattr(node, "lineno", 1), message))

    def visit_all(self, nodes: Sequence[ast.AST | None]) -> None:
        for node in nodes:
            if node is not None:
                self.visit(node)

    # --- names --------------------------------------------------------------------------------------------------

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Load) and node in self.approved:
            return
        if not isinstance(node.ctx, ast.Load):
            self.new_name(node, node.id)
            if node.id in self.functions and node not in self.approved:
                self.refuse("E-DEFINITION", node, f"{node.id} is the name of a function")
        elif node.id in MODULES:
            self.refuse("E-VALUE", node, f"{node.id} is not a value: write the full name of a function, like np.abs")
        elif node.id in self.functions or (node.id in BUILTINS and not self.known(node.id)):
            self.refuse("E-VALUE", node, f"{node.id} is a function, and can only be called")
        elif not self.known(node.id):
            self.refuse("E-NAME", node, f"{node.id} is not defined" + self.hint(node.id, self.names()))

    def new_name(self, node: ast.AST, name: str) -> None:
        if name in MODULES or name in BUILTINS:
            self.refuse("E-DEFINITION", node, f"{name} has a meaning already; choose another name")
        elif name == NAME and not isinstance(node, ast.FunctionDef):
            self.refuse("E-DEFINITION", node, f"{name} must be a function made by def")
        elif name.startswith("__"):
            self.refuse("E-NAME", node, f"{name}: names must not begin with two underscores")

    def known(self, name: str) -> bool:
        return name in self.names()

    def names(self) -> set[str]:
        return set().union(*(scope.names for scope in self.scopes))

    def scope_inputs(self) -> frozenset[str]:
        return self.scopes[-1].inputs

    def instead(self, name: str) -> str:
        return f"; write {INSTEAD[name]}" if name in INSTEAD else ""

    def hint(self, name: str, among: set[str] | frozenset[str]) -> str:
        if name in INSTEAD:
            return self.instead(name)
        if len(self.problems) >= MOST_HINTS or len(name) > LONGEST_HINTED:
            return ""
        near = difflib.get_close_matches(name, sorted(among), 1, 0.8)
        return f"; did you mean {shown(near[0])}?" if near else ""

    # --- expressions --------------------------------------------------------------------------------------------

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, str):
            if node not in self.approved and not is_key(value):
                said = f"the string {value[:30]!r} is no plain word: letters, digits, spaces, _ and - only"
                self.refuse("E-STRING", node, said)
        elif isinstance(value, complex | bytes):
            self.refuse("E-NUMBER", node, f"{str(value)[:30]} is not a real number")
        elif isinstance(value, int) and abs(value) > LARGEST:
            self.refuse("E-NUMBER", node, HUGE)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        name = dotted(node)
        if not isinstance(node.ctx, ast.Load):
            self.refuse("E-STATE", node, f".{node.attr} cannot be assigned")
        elif name is not None:
            if name in DOTTED and name not in CONSTANTS:
                self.refuse("E-VALUE", node, f"{shown(name)} is a function, and can only be called")
            elif name not in CONSTANTS:
                self.unknown(node, name)
        else:
            of_finfo = isinstance(node.value, ast.Call) and dotted(node.value.func) == "numpy.finfo"
            if node.attr in METHODS and not (of_finfo and node.attr in {"max", "min"}):
                self.refuse("E-VALUE", node, f".{node.attr} is a method, and can only be called")
            elif (node.attr not in ATTRIBUTES and not of_finfo) or (
                of_finfo and node.attr not in ATTRIBUTES | {"max", "min"}
            ):
                self.refuse("E-ATTRIBUTE", node, f".{node.attr} is not available")
            self.visit(node.value)

    def unknown(self, node: ast.AST, name: str) -> None:
        """Refuse a dotted name that is not on the list. The message says whether it exists, and why it is not available."""
        module, first, *_ = name.split(".")
        code, reason = {"numpy": ("E-NUMPY", REASONS.get(first)), "math": ("E-MATH", None)}[module]
        if reason is not None:
            said = f"is not available: {reason}{self.instead(name)}"
        elif exists(name):
            said = f"is not allowed{self.instead(name)}"
        else:
            said = f"is not available: there is no such function{self.hint(name, frozenset(DOTTED))}"
        self.refuse(code, node, f"{shown(name)} {said}")

    def visit_Call(self, node: ast.Call) -> None:
        inner = [*node.args, *(one.value for one in node.keywords)]
        if any(isinstance(one, ast.Starred) for one in node.args) or any(one.arg is None for one in node.keywords):
            self.refuse("E-CALL", node, "* and ** in a call are not available")
            self.visit_all([one.value if isinstance(one, ast.Starred) else one for one in inner])
            return
        name = dotted(node.func)
        signature: Signature | None = None
        if name is not None:
            signature = DOTTED.get(name)
            if signature is None:
                self.unknown(node.func, name)
        elif isinstance(node.func, ast.Name):
            name = node.func.id
            if not self.known(name) and name in BUILTINS:
                signature = BUILTINS[name]
            elif name not in self.functions:
                known = (
                    "is a value, and cannot be called" if self.known(name) else "is not a function that is available"
                )
                self.refuse("E-CALL", node, f"{name} {known}{self.hint(name, frozenset(BUILTINS))}")
        elif isinstance(node.func, ast.Attribute):
            name = node.func.attr
            signature = METHODS.get(name)
            if signature is None:
                self.refuse("E-ATTRIBUTE", node, f".{name}() is not available")
            elif name in CHANGING:
                self.changing(node.func.value, node)
            self.visit(node.func.value)
        else:
            self.refuse("E-CALL", node, "only a function that has a name can be called")
            self.approved.add(node.func)  # a lambda has just been refused, because it has no name
            self.visit(node.func)
        if signature is not None and name is not None:
            self.arguments(node, name, signature)
        self.visit_all(inner)

    def arguments(self, node: ast.Call, name: str, signature: Signature) -> None:
        """Check the arguments of a call of a known function."""
        count, given = len(node.args), {one.arg for one in node.keywords}
        by_name = len(given & signature.keywords)
        if count > signature.most or count + by_name < signature.least:
            many = (
                str(signature.most) if signature.least == signature.most else f"{signature.least} to {signature.most}"
            )
            self.refuse("E-CALL", node, f"{shown(name)} takes {many} arguments by position, not {count}")
        for keyword in node.keywords:
            if keyword.arg not in signature.keywords:
                self.refuse("E-KEYWORD", node, f"{shown(name)} has no keyword {keyword.arg} here")
            elif keyword.arg == "dtype":
                self.dtype(keyword.value)
            elif keyword.arg in STRINGS:
                self.written_out(keyword.value, keyword.arg)
        if "where" in given and "out" in signature.keywords and "out" not in given:
            self.refuse("E-KEYWORD", node, f"{shown(name)} with where= needs out= too: memory that nobody has written")
        for place, argument in enumerate(node.args):
            if place == signature.dtype_at:
                self.dtype(argument)
            elif name == "numpy.einsum" and place == 0:
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                    if EINSUM.fullmatch(argument.value.replace(" ", "")):
                        self.approved.add(argument)
                else:
                    self.refuse("E-STRING", node, "the pattern of np.einsum must be written out")
            elif name == "numpy.pad" and place == 2:
                self.written_out(argument, "mode")
        if name == "numpy.finfo":
            self.dtype(node.args[0] if node.args else node)
        self.no_strings(node, name)

    def written_out(self, node: ast.AST, keyword: str) -> None:
        """The value of a keyword that takes a string must be a literal."""
        self.approved.add(node)
        if not is_string(node, STRINGS[keyword]):
            known = ", ".join(sorted(STRINGS[keyword]))
            self.refuse("E-STRING", node, f"{keyword} must be written out: one of {known}")

    def dtype(self, node: ast.AST) -> None:
        """A dtype must be one of the allowed literals, so that no other dtype is possible."""
        if is_string(node, DTYPE_NAMES) or (isinstance(node, ast.Name) and node.id in {"float", "int", "bool"}):
            self.approved.add(node)
        elif (dotted(node) or "").removeprefix("numpy.") not in DTYPES and not (
            isinstance(node, ast.Attribute) and node.attr == "dtype"
        ):
            self.refuse("E-DTYPE", node, f"a dtype must be one of {', '.join('np.' + name for name in sorted(DTYPES))}")

    def changing(self, target: ast.AST, node: ast.AST) -> None:
        """Check that `target`, which the program changes, belongs to this function."""
        while isinstance(target, ast.Subscript | ast.Attribute | ast.Call):
            target = target.func if isinstance(target, ast.Call) else target.value
        if isinstance(target, ast.Name):
            if target.id in self.scope_inputs():
                self.refuse("E-INPUT", node, f"this writes into the input {target.id}: copy it first")
            elif len(self.scopes) > 1 and target.id not in self.scopes[-1].names:
                self.refuse("E-STATE", node, f"{target.id} belongs to another place, and cannot be changed here")

    def no_strings(self, node: ast.Call, name: str) -> None:
        """Refuse strings in a call of a function that takes none. Strings that a function may take have been approved before."""
        if name == "get":
            return
        for one in [*node.args, *(keyword.value for keyword in node.keywords)]:
            if isinstance(one, ast.Constant) and isinstance(one.value, str) and one not in self.approved:
                self.approved.add(one)
                self.refuse("E-STRING", one, f"{shown(name)} takes no string here: {one.value[:30]!r}")

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self.visit_all([node.value, node.target])

    def visit_Starred(self, node: ast.Starred) -> None:
        """A star in an assignment. Stars in lists have been rewritten, and stars in calls are refused by `visit_Call`."""
        if node not in self.approved:
            self.refuse("E-CONSTRUCT", node, "* is available in lists, and once on the left of an assignment")
        self.visit(node.value)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if not isinstance(node.ctx, ast.Load):
            self.changing(node.value, node)
        self.visit_all([node.value, node.slice])

    def visit_Slice(self, node: ast.Slice) -> None:
        self.visit_all([node.lower, node.upper, node.step])

    def visit_Dict(self, node: ast.Dict) -> None:
        if None in node.keys:
            self.refuse("E-CONSTRUCT", node, "** in a dictionary is not available")
        self.visit_all([*node.keys, *node.values])

    def visit_List(self, node: ast.List) -> None:
        self.visit_all(node.elts)

    def visit_Tuple(self, node: ast.Tuple) -> None:
        self.visit_all(node.elts)

    def operator(self, operator: ast.AST, node: ast.AST) -> None:
        if not isinstance(operator, OPERATORS):
            self.refuse("E-CONSTRUCT", node, f"the operator {type(operator).__name__} is not available")

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self.operator(node.op, node)
        if isinstance(node.op, ast.Pow) and isinstance(node.right, ast.BinOp) and isinstance(node.right.op, ast.Pow):
            sides = node.left, node.right.left, node.right.right
            if not any(isinstance(side, ast.Constant) and isinstance(side.value, float) for side in sides):
                self.refuse("E-NUMBER", node, "a power of a power of integers has no bound: make one a float")
        self.visit_all([node.left, node.right])

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self.operator(node.op, node)
        self.visit(node.operand)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.visit_all(node.values)

    def visit_Compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        for operator, pair in zip(node.ops, itertools.pairwise(sides), strict=True):
            # NumPy has one object True and one object False, so that `is` would compare values, as == does.
            if isinstance(operator, ast.Is | ast.IsNot) and not any(map(is_singleton, pair)):
                self.refuse("E-CONSTRUCT", node, "is and is not stand beside None, True or False only: use ==")
        self.visit_all(sides)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self.visit_all([node.test, node.body, node.orelse])

    def visit_ListComp(self, node: ast.ListComp | ast.GeneratorExp) -> None:
        self.visit_all([*node.generators, node.elt])

    def visit_GeneratorExp(self, node: ast.GeneratorExp) -> None:
        self.visit_ListComp(node)

    def visit_DictComp(self, node: ast.DictComp) -> None:
        self.visit_all([*node.generators, node.key, node.value])

    def visit_comprehension(self, node: ast.comprehension) -> None:
        if node.is_async:
            self.refuse("E-CONSTRUCT", node.target, "async is not available")
        self.visit_all([node.target, node.iter, *node.ifs])
