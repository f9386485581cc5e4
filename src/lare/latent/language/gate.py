"""The static gate checks the syntax tree of a program. Nothing is executed.

The language is closed: a node, name, attribute, keyword or string that `allowed.py` does not list is refused. This gives precise
errors, and most attacks cannot be expressed. But the gate is not the security boundary. The boundary is the sandbox, in which the
gate and everything after it runs.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass

from lare.latent.language.allowed import FUTURE, MODULES, NAME, TYPING
from lare.latent.language.expressions import HUGE, Expressions, Problem, Scope
from lare.latent.language.simplify import simplified
from lare.latent.language.syntax import (
    assigned,
    beneath,
    definitions,
    dotted,
    evaluated,
    is_docstring,
    is_key,
    is_name,
    is_number,
    is_string,
    parameters,
    rebound,
)
from lare.legible import unseen

CONSTRUCTS = {
    ast.While: "while",
    ast.Try: "try",
    ast.Raise: "raise",
    ast.ClassDef: "class",
    ast.Global: "global",
    ast.Nonlocal: "nonlocal",
    ast.Delete: "del",
    ast.JoinedStr: "an f-string",
    ast.Match: "match",
    ast.Yield: "yield",
    ast.YieldFrom: "yield",
    ast.Await: "await",
    ast.AsyncFunctionDef: "async",
    ast.AsyncFor: "async",
    ast.AsyncWith: "async",
    ast.Set: "a set",
    ast.SetComp: "a set",
}
"""The names of the most common constructs that are not available."""

KEPT = (
    *(ast.While, ast.Try, ast.TryStar, ast.AsyncFor, ast.AsyncWith, ast.Set, ast.SetComp),
    *(ast.Yield, ast.YieldFrom, ast.Await),
)
"""The code inside these constructs is checked too, because a repair often removes only the `while` or the `try`."""


@dataclass
class Gate(Expressions, ast.NodeVisitor):
    """Visits a program and records what is not in the language. There is one method for each allowed node."""

    def generic_visit(self, node: ast.AST) -> None:
        name = CONSTRUCTS.get(type(node), type(node).__name__)
        self.refuse("E-CONSTRUCT", node, f"{name} is not available")
        if isinstance(node, KEPT):
            self.visit_all(list(beneath(node)))

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
            if is_number(default) or (isinstance(default, ast.Constant) and is_key(default.value)):
                self.visit(default)
            else:
                self.refuse("E-STATE", default, "a default must be a number, a plain word or None")
        for argument in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]:
            self.new_name(argument, argument.arg)
            self.annotation(argument.annotation)
            if argument.arg in self.functions:
                self.refuse("E-DEFINITION", argument, f"{argument.arg} is the name of a function")
        self.scopes.append(Scope(bound | parameters(arguments), inputs))

    def annotation(self, node: ast.expr | None) -> None:
        """Annotations are never evaluated. They must still be plain types, so that no other code can appear in them."""
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
        for target in node.targets:
            if isinstance(target, ast.Tuple | ast.List):
                self.approved |= {one for one in target.elts if isinstance(one, ast.Starred)}
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


def recursion(tree: ast.Module, functions: frozenset[str]) -> Iterator[Problem]:
    """The functions that can call themselves."""
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


LONGEST = 20_000
"""The largest size of a program, in bytes."""

DEEPEST_BRACKETS = 40
DEEPEST = 100
"""The most levels of the syntax tree."""

CHAIN = re.compile(r"(?:[-+~]\s*){12}|(?:\bnot\s+){12}|(?:\blambda\s*:\s*){12}")
"""Chains of operators that nest without brackets, and could exhaust the parser's stack."""

BREAKS = str.maketrans("\r\f", "\n\n")
"""Characters that Python treats as the end of a line, or as a space."""

LETTERS = frozenset({tokenize.COMMENT, tokenize.STRING})
"""Tokens that may contain letters of every script. Elsewhere, letters that look alike could be confused: Cyrillic a and Latin a."""

UNREAD = re.compile(r'"""[^\\]*?"""|#[^\n]*', re.DOTALL)
"""Comments and docstrings, where rows of brackets and operators are harmless. For code that only looks like one of these, the
parser's own limits still apply."""


def inspect(source: str) -> list[Problem]:
    """All problems of a program, in the order of its lines. There are none if the program may run."""
    too_much = list(guard(source))
    if too_much:
        return too_much
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        said = HUGE if error.msg.startswith("Exceeds the limit") else error.msg
        return [Problem("E-NUMBER" if said == HUGE else "E-SYNTAX", error.lineno or 1, said)]
    except (ValueError, MemoryError, RecursionError) as error:
        return [Problem("E-SYNTAX", 1, f"this cannot be parsed: {str(error) or type(error).__name__}")]
    try:
        foreign = list(other_letters(source))
    except (tokenize.TokenError, SyntaxError):  # the tokenizer differs from the parser
        foreign = [Problem("E-SYNTAX", 1, "this cannot be taken apart: write it in ASCII")]
    if foreign:
        return foreign
    # The tree may become deeper when it is simplified.
    if depth(tree) > DEEPEST or depth(tree := simplified(tree)) > DEEPEST:
        return [Problem("E-SIZE", 1, f"the expressions are nested more than {DEEPEST} deep")]
    gate = Gate(definitions(tree))
    gate.visit(tree)
    return sorted({*gate.problems, *recursion(tree, gate.functions)}, key=lambda problem: (problem.line, problem))


def other_letters(source: str) -> Iterator[Problem]:
    """Letters that are not ASCII, outside of comments and strings. The source has been parsed."""
    if source.isascii():
        return
    for token in tokenize.generate_tokens(io.StringIO(source, newline=None).readline):
        if token.type not in LETTERS and not token.string.isascii():
            letter = next(one for one in token.string if not one.isascii())
            said = f"{letter!a} is no letter of a program: only ASCII stands outside of comments"
            yield Problem("E-SYNTAX", token.start[0], said)


def guard(source: str) -> Iterator[Problem]:
    """The problems that must be found before a text is parsed."""
    size = len(source.encode(errors="replace"))
    if any("\ud800" <= letter <= "\udfff" for letter in source):
        yield Problem("E-SYNTAX", 1, "there are characters that are no text (surrogates)")
        return
    if size > LONGEST:
        yield Problem("E-SIZE", 1, f"the program has {size} bytes; at most {LONGEST} are accepted")
        return
    hidden = unseen(source.translate(BREAKS))  # a reader of the function must see every character
    if hidden is not None:
        line, letter = source.count("\n", 0, hidden) + 1, source[hidden]
        yield Problem("E-SYNTAX", line, f"there is {letter!a}, a character that nobody sees: only text, please")
        return
    code = UNREAD.sub(lambda found: "\n" * found[0].count("\n"), source)
    nested = 0
    for number, line in enumerate(code.split("\n"), start=1):
        for character in line:
            nested = max(0, nested + (character in "([{") - (character in ")]}"))
            if nested > DEEPEST_BRACKETS:
                yield Problem("E-SIZE", number, f"brackets are nested more than {DEEPEST_BRACKETS} deep")
                return
    chain = CHAIN.search(code)
    if chain:
        yield Problem("E-SIZE", code.count("\n", 0, chain.start()) + 1, "a chain of operators is too long")


def depth(tree: ast.AST) -> int:
    """The number of levels of a syntax tree."""
    level, found = [tree], 0
    while level:
        found += 1
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    return found
