"""Checks the shapes of arrays at run time. It must be imported before the package.

Functions of modules and classes are checked if they annotate arrays. jaxtyping's own import hook also wraps functions without arrays,
and wraps local functions again whenever they are defined: a test then takes two to four times as long.
"""

import ast
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder, SourceFileLoader

from beartype import beartype
from jaxtyping import jaxtyped

PACKAGE, DECORATOR = "lare_rl", "_check_shapes"


def array_names(tree: ast.Module) -> set[str]:
    """Return the names of jaxtyping that a module imports, and the names of its own types that are made of them."""
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "jaxtyping"]
    names = {alias.name for node in imports for alias in node.names}
    for node in tree.body:
        if isinstance(node, ast.Assign) and mentions(node.value, names):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def mentions(node: ast.AST | None, names: set[str]) -> bool:
    return node is not None and any(isinstance(child, ast.Name) and child.id in names for child in ast.walk(node))


def annotations(definition: ast.AST) -> Iterator[ast.AST | None]:
    match definition:
        case ast.FunctionDef(args=arguments):
            yield definition.returns
            yield from (node.annotation for node in ast.walk(arguments) if isinstance(node, ast.arg))
        case ast.ClassDef():
            yield from (node.annotation for node in definition.body if isinstance(node, ast.AnnAssign))


class Loader(SourceFileLoader):
    def get_code(self, fullname):
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        if not (names := array_names(tree)):
            return super().get_code(fullname)
        methods = [node for parent in tree.body if isinstance(parent, ast.ClassDef) for node in parent.body]
        for definition in [*tree.body, *methods]:
            if any(mentions(annotation, names) for annotation in annotations(definition)):
                decorator = ast.copy_location(ast.Name(DECORATOR, ast.Load()), definition)
                # A dataclass is checked after it is made; a function before other decorators change it.
                first = 0 if isinstance(definition, ast.ClassDef) else len(definition.decorator_list)
                definition.decorator_list.insert(first, decorator)
        return compile(tree, path, "exec", dont_inherit=True)

    def exec_module(self, module):
        vars(module)[DECORATOR] = jaxtyped(typechecker=beartype)
        super().exec_module(module)


class Finder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        spec = PathFinder.find_spec(name, path, target) if name.partition(".")[0] == PACKAGE else None
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = Loader(name, spec.loader.path)
        return spec


assert PACKAGE not in sys.modules
sys.meta_path.insert(0, Finder)
