"""The grammar of the language: a walk over a syntax tree that notes everything that is not in it."""

import ast
import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from lare.latent.language import (
    ATTRIBUTES,
    BUILTINS,
    CHANGING,
    CONSTANTS,
    DOTTED,
    DTYPE_NAMES,
    DTYPES,
    EINSUM,
    FUTURE,
    INSTEAD,
    METHODS,
    MODULES,
    NAME,
    REASONS,
    STRINGS,
    TYPING,
    Signature,
)
from lare.latent.syntax import (
    Function,
    assigned,
    beneath,
    definitions,
    dotted,
    evaluated,
    exists,
    is_docstring,
    is_key,
    is_name,
    is_number,
    is_string,
    parameters,
    rebound,
    shown,
)

LARGEST = 2**63
"""Of the integers that may stand in a program."""


MOST_HINTS, LONGEST_HINTED = 10, 40
"""Looking for a name that was meant takes time: only for so many problems, and names of so many letters."""


class Problem(NamedTuple):
    """Something that a program must not contain."""

    code: str
    line: int
    message: str

    def __str__(self) -> str:
        return f"{self.code} line {self.line}: {self.message}"


CONSTRUCTS = {
    ast.While: "while",
    ast.Try: "try",
    ast.Raise: "raise",
    ast.Assert: "assert",
    ast.ClassDef: "class",
    ast.Global: "global",
    ast.Nonlocal: "nonlocal",
    ast.Delete: "del",
    ast.JoinedStr: "an f-string",
    ast.NamedExpr: "the operator :=",
    ast.Match: "match",
    ast.Yield: "yield",
    ast.YieldFrom: "yield",
    ast.Await: "await",
    ast.AsyncFunctionDef: "async",
    ast.AsyncFor: "async",
    ast.AsyncWith: "async",
    ast.Set: "a set",
    ast.SetComp: "a set",
    ast.Starred: "* in a call",
}
"""How the commonest of what is not available is called."""

KEPT = (
    *(ast.While, ast.Try, ast.TryStar, ast.AsyncFor, ast.AsyncWith, ast.Set, ast.SetComp, ast.Starred),
    *(ast.NamedExpr, ast.Yield, ast.YieldFrom, ast.Await),
)
"""Of these, what stands in them stays when they go, and so has to be right."""

OPERATORS = (
    *(ast.Add, ast.Sub, ast.Mult, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow, ast.MatMult),
    *(ast.BitAnd, ast.BitOr, ast.BitXor, ast.UAdd, ast.USub, ast.Not, ast.Invert),
)


@dataclass(frozen=True)
class Scope:
    """A function, or the module, and the names that are bound in it."""

    names: set[str]
    inputs: frozenset[str] = frozenset()
    """Names that still mean the function's inputs, which nobody may write into."""


@dataclass
class Gate(ast.NodeVisitor):
    """Walks over a program and notes what is not in the language. One method for each node that is."""

    defined: list[tuple[str, Function]]
    problems: list[Problem] = field(default_factory=list)
    scopes: list[Scope] = field(default_factory=list)
    approved: set[ast.AST] = field(default_factory=set)
    """Strings and lambdas that stand where they may."""

    @property
    def functions(self) -> frozenset[str]:
        return frozenset(name for name, _ in self.defined)

    def refuse(self, code: str, node: ast.AST, message: str) -> None:
        self.problems.append(Problem(code, getattr(node, "lineno", 1), message))

    def generic_visit(self, node: ast.AST) -> None:
        name = CONSTRUCTS.get(type(node), type(node).__name__)
        self.refuse("E-CONSTRUCT", node, f"{name} is not available")
        if isinstance(node, KEPT):
            self.visit_all(list(beneath(node)))

    def visit_all(self, nodes: Sequence[ast.AST | None]) -> None:
        for node in nodes:
            if node is not None:
                self.visit(node)

    # --- the module ---------------------------------------------------------------------------------------------

    def visit_Module(self, node: ast.Module) -> None:
        self.scopes.append(Scope(assigned(node)))
        seen: set[str] = set()
        for name, function in self.defined:
            if name in seen:
                self.refuse("E-DEFINITION", function, f"{name} is defined twice")
            seen.add(name)
        for statement in node.body:
            if isinstance(statement, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.Assign | ast.AnnAssign):
                self.visit(statement)
            elif not is_docstring(statement):
                self.refuse(
                    "E-MODULE", statement, "only imports, functions and constants may stand outside of functions"
                )
        main = [one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == NAME]
        if not main:
            self.refuse("E-DEFINITION", node, f"there is no function {NAME}(observation, action)")
        elif len(parameters(main[0].args)) != 2 or len(main[0].args.posonlyargs + main[0].args.args) != 2:
            self.refuse("E-DEFINITION", main[0], f"{NAME} must take exactly two arguments, observation and action")
        self.scopes.pop()

    def visit_Import(self, node: ast.Import) -> None:
        for one in node.names:
            if MODULES.get(one.asname or one.name) != one.name:
                self.refuse(
                    "E-IMPORT", node, f"import {one.name}: only `import numpy as np` and `import math` are available"
                )

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        names = {one.name for one in node.names}
        unnamed = all(one.asname is None for one in node.names)
        if node.level or node.module not in {"typing", "__future__"} or not unnamed:
            module = "." * node.level + (node.module or "")
            self.refuse(
                "E-IMPORT", node, f"from {module} import: write `import numpy as np` and the function's full name"
            )
        elif not names <= (there := TYPING if node.module == "typing" else FUTURE):
            self.refuse("E-IMPORT", node, f"from {node.module} import: only {', '.join(sorted(there))}")

    # --- functions ----------------------------------------------------------------------------------------------

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.decorator_list:
            self.refuse("E-CONSTRUCT", node, "a decorator is not available")
        if getattr(node, "type_params", None):
            self.refuse("E-CONSTRUCT", node, "type parameters are not available")
        self.new_name(node, node.name)
        self.annotation(node.returns)
        inputs = parameters(node.args) - rebound(node) if node.name == NAME else set()
        self.enter(node.args, assigned(node), frozenset(inputs))
        self.visit_all(node.body)
        self.scopes.pop()

    def visit_Lambda(self, node: ast.Lambda) -> None:
        if node not in self.approved:
            self.refuse("E-CALL", node, "a lambda must be given a name, and be called by it: name = lambda ...")
            return
        self.enter(node.args, assigned(node))
        self.visit(node.body)
        self.scopes.pop()

    def enter(self, arguments: ast.arguments, bound: set[str], inputs: frozenset[str] = frozenset()) -> None:
        if arguments.vararg or arguments.kwarg:
            self.refuse("E-CONSTRUCT", arguments.vararg or arguments.kwarg or arguments, "* in a function's head")
        for default in [*arguments.defaults, *arguments.kw_defaults]:
            if default is None:
                continue
            if is_number(default):
                self.visit(default)
            else:
                self.refuse("E-STATE", default, "a default must be a number or None")
        for argument in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]:
            self.new_name(argument, argument.arg)
            self.annotation(argument.annotation)
            if argument.arg in self.functions:
                self.refuse("E-DEFINITION", argument, f"{argument.arg} is the name of a function")
        self.scopes.append(Scope(bound | parameters(arguments), inputs))

    def annotation(self, node: ast.expr | None) -> None:
        """Annotations are never evaluated; they only must not look as if they did something."""
        allowed = (
            ast.Name,
            ast.Attribute,
            ast.Subscript,
            ast.Tuple,
            ast.List,
            ast.Constant,
            ast.BinOp,
            ast.BitOr,
            ast.Load,
        )
        for inner in ast.walk(node) if node is not None else ():
            if not isinstance(inner, allowed):
                self.refuse("E-CONSTRUCT", node or inner, "an annotation must be a plain type")
                return

    # --- statements ---------------------------------------------------------------------------------------------

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.value, ast.Lambda) and len(node.targets) == 1 and is_name(node.targets[0]):
            self.approved |= {node.value, node.targets[0]}
        self.visit_all([*node.targets, node.value])

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.annotation(node.annotation)
        self.visit_all([node.target, node.value])

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if isinstance(node.target, ast.Name) and node.target.id in self.scope_inputs():
            self.refuse("E-INPUT", node, f"`{node.target.id} ...=` writes into the input: copy it first")
        self.operator(node.op, node)
        self.visit_all([node.target, node.value])

    def visit_For(self, node: ast.For) -> None:
        self.visit_all([node.target, node.iter, *node.body, *node.orelse])

    def visit_If(self, node: ast.If) -> None:
        self.visit_all([node.test, *node.body, *node.orelse])

    def visit_Return(self, node: ast.Return) -> None:
        self.visit_all([node.value])

    def visit_Expr(self, node: ast.Expr) -> None:
        if not is_docstring(node):
            self.visit(node.value)

    def visit_Pass(self, node: ast.Pass) -> None: ...

    def visit_Break(self, node: ast.Break) -> None: ...

    def visit_Continue(self, node: ast.Continue) -> None: ...

    def visit_With(self, node: ast.With) -> None:
        call = node.items[0].context_expr
        fitting = (
            len(node.items) == 1
            and node.items[0].optional_vars is None
            and isinstance(call, ast.Call)
            and dotted(call.func) == "numpy.errstate"
            and not call.args
            and all(
                one.arg in {"all", "divide", "over", "under", "invalid"} and is_string(one.value, {"ignore"})
                for one in call.keywords
            )
        )
        if not fitting:
            self.refuse(
                "E-CONSTRUCT", node, "with is available only as `with np.errstate(divide='ignore')` and the like"
            )
        self.visit_all(node.body)

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
            if node not in self.approved:
                self.refuse("E-STRING", node, f"the string {value[:30]!r} is not available here")
        elif isinstance(value, complex | bytes):
            self.refuse("E-NUMBER", node, f"{str(value)[:30]} is not a real number")
        elif isinstance(value, int) and abs(value) > LARGEST:
            self.refuse("E-NUMBER", node, "an integer is larger than 2**63")

    def approve(self, *nodes: ast.AST | None) -> None:
        """Let strings through that are keys of dictionaries."""
        self.approved |= {node for node in nodes if isinstance(node, ast.Constant) and is_key(node.value)}

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
        """A dotted name that is not on the list: say whether there is such a thing, and why it is not available."""
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
            if name == "get":
                self.approve(*node.args[:1])
            self.visit(node.func.value)
        else:
            self.refuse("E-CALL", node, "only a function that has a name can be called")
            self.approved.add(node.func)  # a lambda: that it has no name has been said
            self.visit(node.func)
        if signature is not None and name is not None:
            self.arguments(node, name, signature)
        self.visit_all(inner)

    def arguments(self, node: ast.Call, name: str, signature: Signature) -> None:
        """Whether a call of a known function is one that the language has."""
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

    def written_out(self, node: ast.AST, keyword: str) -> None:
        """A keyword that takes a string must show which one."""
        self.approved.add(node)
        if not is_string(node, STRINGS[keyword]):
            known = ", ".join(sorted(STRINGS[keyword]))
            self.refuse("E-STRING", node, f"{keyword} must be written out: one of {known}")

    def dtype(self, node: ast.AST) -> None:
        """A dtype must stand there as it is, so that no other can come in."""
        if is_string(node, DTYPE_NAMES) or (isinstance(node, ast.Name) and node.id in {"float", "int", "bool"}):
            self.approved.add(node)
        elif (dotted(node) or "").removeprefix("numpy.") not in DTYPES and not (
            isinstance(node, ast.Attribute) and node.attr == "dtype"
        ):
            self.refuse("E-DTYPE", node, f"a dtype must be one of {', '.join('np.' + name for name in sorted(DTYPES))}")

    def changing(self, target: ast.AST, node: ast.AST) -> None:
        """Something is written into; it must belong to this function."""
        while isinstance(target, ast.Subscript | ast.Attribute | ast.Call):
            target = target.func if isinstance(target, ast.Call) else target.value
        if isinstance(target, ast.Name):
            if target.id in self.scope_inputs():
                self.refuse("E-INPUT", node, f"this writes into the input {target.id}: copy it first")
            elif len(self.scopes) > 1 and target.id not in self.scopes[-1].names:
                self.refuse("E-STATE", node, f"{target.id} belongs to another place, and cannot be changed here")

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.approve(node.slice)
        if not isinstance(node.ctx, ast.Load):
            self.changing(node.value, node)
        self.visit_all([node.value, node.slice])

    def visit_Slice(self, node: ast.Slice) -> None:
        self.visit_all([node.lower, node.upper, node.step])

    def visit_Dict(self, node: ast.Dict) -> None:
        if None in node.keys:
            self.refuse("E-CONSTRUCT", node, "** in a dictionary is not available")
        self.approve(*node.keys)
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
            self.refuse("E-NUMBER", node, "a power of a power grows without bound")
        self.visit_all([node.left, node.right])

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self.operator(node.op, node)
        self.visit(node.operand)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.visit_all(node.values)

    def visit_Compare(self, node: ast.Compare) -> None:
        if isinstance(node.ops[0], ast.In | ast.NotIn):
            self.approve(node.left)
        self.visit_all([node.left, *node.comparators])

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self.visit_all([node.test, node.body, node.orelse])

    def visit_ListComp(self, node: ast.ListComp | ast.GeneratorExp) -> None:
        self.visit_all([*node.generators, node.elt])

    def visit_GeneratorExp(self, node: ast.GeneratorExp) -> None:
        self.visit_ListComp(node)

    def visit_DictComp(self, node: ast.DictComp) -> None:
        self.approve(node.key)
        self.visit_all([*node.generators, node.key, node.value])

    def visit_comprehension(self, node: ast.comprehension) -> None:
        if node.is_async:
            self.refuse("E-CONSTRUCT", node.target, "async is not available")
        self.visit_all([node.target, node.iter, *node.ifs])


def recursion(tree: ast.Module, functions: frozenset[str]) -> Iterator[Problem]:
    """A function that can come back to itself."""
    calls = {
        name: {
            inner.func.id
            for inner in evaluated(node)
            if isinstance(inner, ast.Call) and isinstance(inner.func, ast.Name) and inner.func.id in functions
        }
        for name, node in definitions(tree)
    }
    for name, node in definitions(tree):
        reached: set[str] = set()
        frontier = set(calls[name])
        while frontier:
            reached |= frontier
            frontier = set().union(*(calls[one] for one in frontier)) - reached
        if name in reached:
            yield Problem("E-RECURSION", node.lineno, f"{name} calls itself, directly or through others")
