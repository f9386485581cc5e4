"""What the functions and methods of a program need of the interpreter. They take it as their first argument."""

import ast
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lare_rl.phi.builder import Builder
from lare_rl.phi.meter import Meter
from lare_rl.phi.values import Function, Scope

__all__ = ["Runtime"]


class Runtime(ABC):
    """A program that is carried out. `Interpreter` says where each method is defined."""

    builder: Builder
    meter: Meter
    module: Scope
    line: int
    """Line that is being carried out."""
    call_depth: int
    has_yield: bool
    """Whether the source has the word `yield` somewhere."""

    @abstractmethod
    def run(self, statements: Iterable[ast.stmt], scope: Scope, /) -> None: ...
    @abstractmethod
    def assign(self, target: ast.expr, value: Any, scope: Scope, /) -> None: ...
    @abstractmethod
    def evaluate(self, node: ast.expr, scope: Scope, /) -> Any: ...
    @abstractmethod
    def entries(self, nodes: Sequence[ast.expr], scope: Scope, /) -> list[Any]: ...
    @abstractmethod
    def define(self, node: ast.FunctionDef | ast.Lambda, scope: Scope, /) -> Function: ...
    @abstractmethod
    def binary(self, op: ast.operator, x: Any, y: Any, /) -> Any: ...
    @abstractmethod
    def item(self, container: Any, index: Any, /) -> Any: ...
    @abstractmethod
    def items(self, value: Any, /) -> Sequence[Any]: ...
    @abstractmethod
    def truth(self, value: Any, /) -> bool: ...
    @abstractmethod
    def attribute(self, owner: Any, name: str, /) -> Any: ...
    @abstractmethod
    def call(self, function: Any, args: Sequence[Any], kwargs: Mapping[str, Any], /) -> Any: ...
