"""Rewrites some constructs to equivalent ones that the language has. The gate checks the result, and the result is what runs.

from numpy.linalg import norm; norm(x)      np.linalg.norm(x)
map(lambda x: 2 * x, xs), filter(...)       [2 * x for x in xs]
dict(a=1)                                   {"a": 1}
[*a, x], first, *rest = xs                  list(a) + [x], first, *rest = list(xs)
assert, if __name__ == "__main__":          removed, as by `python -O`, and as in an imported module
"""

import ast

FROM = ("numpy", "numpy.linalg", "math")
"""Modules whose functions may be imported by their names."""


def simplified(tree: ast.Module) -> ast.Module:
    """The simplified tree of a program. The given tree is changed."""
    imported = {name: where for name, where in imports(tree).items() if name not in bound(tree)}
    return ast.fix_missing_locations(Simplify(imported).visit(tree))


def imports(tree: ast.Module) -> dict[str, str]:
    """Names that are imported from NumPy and math, and their full names."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and not node.level and node.module in FROM:
            found |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names if one.name != "*"}
        elif isinstance(node, ast.Import):
            found |= {one.asname: one.name for one in node.names if one.asname and one.name == "numpy.linalg"}
    return found


def bound(tree: ast.Module) -> set[str]:
    """Every name that is bound by something other than an import."""
    found = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    found |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return found | {
        node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)
    }


def full_name(where: str) -> ast.expr:
    """The expression `np.linalg.norm` for `numpy.linalg.norm`."""
    module, *parts = where.split(".")
    node: ast.expr = ast.Name({"numpy": "np"}.get(module, module), ast.Load())
    for part in parts:
        node = ast.Attribute(node, part, ast.Load())
    return node


def call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def is_main(node: ast.stmt) -> bool:
    """Whether a statement is `if __name__ == "__main__":`, which does not run in an imported module."""
    return isinstance(node, ast.If) and not node.orelse and ast.unparse(node.test) == "__name__ == '__main__'"


class Simplify(ast.NodeTransformer):
    """Rewrites a whole tree, from the leaves upwards."""

    def __init__(self, imported: dict[str, str]):
        self.imported = imported

    def visit_Module(self, node: ast.Module) -> ast.Module:
        node.body = [one for one in node.body if not is_main(one)]
        self.generic_visit(node)
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.stmt:
        known = (
            not node.level
            and node.module in FROM
            and all((one.asname or one.name) in self.imported for one in node.names)
        )
        return ast.copy_location(ast.Import([ast.alias("numpy", "np")]), node) if known else node

    def visit_Import(self, node: ast.Import) -> ast.stmt:
        for one in node.names:
            if one.asname in self.imported:
                one.name, one.asname = "numpy", "np"
        return node

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if isinstance(node.ctx, ast.Load) and node.id in self.imported:
            return ast.copy_location(full_name(self.imported[node.id]), node)
        return node

    def visit_Assert(self, node: ast.Assert) -> ast.stmt:
        return ast.copy_location(ast.Pass(), node)

    def visit_Assign(self, node: ast.Assign) -> ast.stmt:
        self.generic_visit(node)
        if any(isinstance(target, ast.Tuple | ast.List) and starred(target.elts) for target in node.targets):
            node.value = ast.copy_location(call("list", node.value), node.value)
        return node

    def visit_List(self, node: ast.List) -> ast.expr:
        return self.display(node, "list")

    def visit_Tuple(self, node: ast.Tuple) -> ast.expr:
        return self.display(node, "tuple")

    def display(self, node: ast.List | ast.Tuple, kind: str) -> ast.expr:
        self.generic_visit(node)
        if not isinstance(node.ctx, ast.Load) or not starred(node.elts):
            return node
        parts = [
            call(kind, one.value) if isinstance(one, ast.Starred) else type(node)([one], ast.Load())
            for one in node.elts
        ]
        joined: ast.expr = type(node)([], ast.Load())
        for part in parts:
            joined = ast.BinOp(joined, ast.Add(), part)
        return ast.copy_location(joined, node)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        simple = not starred(node.args) and all(one.arg for one in node.keywords)
        if name == "dict" and simple and node.keywords and not node.args:
            keys: list[ast.expr | None] = [ast.Constant(one.arg) for one in node.keywords]
            return ast.copy_location(ast.Dict(keys, [one.value for one in node.keywords]), node)
        if name == "float" and len(node.args) == 1 and is_infinity(node.args[0]):
            return ast.copy_location(full_name("math.inf"), node)
        if name in ("map", "filter") and simple and len(node.args) > 1 and not node.keywords:
            made = comprehension(name, *node.args)
            return node if made is None else ast.copy_location(made, node)
        return node


def is_infinity(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.lower() in ("inf", "infinity")


def starred(nodes: list[ast.expr]) -> bool:
    return any(isinstance(one, ast.Starred) for one in nodes)


def comprehension(name: str, function: ast.expr, *values: ast.expr) -> ast.ListComp | None:
    """The list comprehension that replaces `map` or `filter`; None if there is no simple one."""
    if isinstance(function, ast.Lambda):
        names = [one.arg for one in function.args.args]
        if len(names) != len(values) or len(vars_of(function.args)) != len(names) or function.args.defaults:
            return None
        body = function.body
    else:
        names = [f"$item{number}" for number in range(len(values))]  # no source can contain such a name
        body = ast.Call(function, [ast.Name(one, ast.Load()) for one in names], [])
    targets: list[ast.expr] = [ast.Name(one, ast.Store()) for one in names]
    target = targets[0] if len(targets) == 1 else ast.Tuple(targets, ast.Store())
    gone_through = values[0] if len(values) == 1 else call("zip", *values)
    if name == "map":
        return ast.ListComp(body, [ast.comprehension(target, gone_through, [], 0)])
    if len(values) != 1:
        return None
    return ast.ListComp(ast.Name(names[0], ast.Load()), [ast.comprehension(target, gone_through, [body], 0)])


def vars_of(arguments: ast.arguments) -> list[ast.arg]:
    """Every parameter, of whatever kind."""
    rest = [one for one in (arguments.vararg, arguments.kwarg) if one is not None]
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, *rest]
