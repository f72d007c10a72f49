"""Formulas over points and time: parsed from text, evaluated without executing Python code.

Knows numbers, names and a few functions; knows no point: the caller says what a name means.

1. A formula may contain: numbers; ``+ - * / // % **``; comparisons, ``and or not``, ``a if b else c``; the functions
   below; ``t``, seconds since the beginning; ``pi``; names of points, dots included; ``point("…")`` for any other name,
   such as ``point("3/voltage L1")``, which is a point of unit 3.
2. What cannot be computed (a division by zero, the root of -1) is NaN. True is 1 and False is 0.
3. A formula has a bounded number of characters and levels, so that evaluating it takes a bounded time. Intermediate
   results are bounded too: powers are computed as floats, rounding takes at most `_MOST_DIGITS` digits, and whole
   numbers from outside have at most `WHOLE_BITS` bits. `Expression.result` checks its inputs; those of
   `Expression.bind` are numbers from registers, which have no more bits: files with other inputs are refused.
4. It uses the standard library's ``ast`` and no package for expressions: formulas come from files of others, and rule 3
   must hold.
"""

import ast
import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from ..errors import ConfigError
from ..values.unfit_values import shown

Number = float | int | bool
Compute = Callable[[float], Any]  # of the time; a number, of whatever type Python makes it
BoundExpression = Callable[[float], float]

_LONGEST: Final = 1000
_DEEPEST: Final = 40
_MOST_DIGITS: Final = 400
"""Most digits for rounding, before or after the decimal point: no 64-bit number and no float has more."""
WHOLE_BITS: Final = 64
"""Most bits of a whole number that is an input of an expression, or its result."""
TIME: Final = "t"
_POINT: Final = "point"
_CONSTANTS: Final = {"pi": math.pi}


def _rounded(value: Any, digits: Any = 0) -> Any:
    """Round a number like ``round``, but with a bounded number of digits, so that a formula cannot take long.

    ``round`` of an integer to -n digits computes 10 to the power of n.
    """
    return round(value, max(-_MOST_DIGITS, min(int(digits), _MOST_DIGITS)))


_BINARY: Final[dict[type[ast.operator], Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: math.pow,  # whole powers of whole numbers could be of any size
}
_UNARY: Final[dict[type[ast.unaryop], Callable[[Any], Any]]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
}
_COMPARISONS: Final[dict[type[ast.cmpop], Callable[[Any, Any], bool]]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_FUNCTIONS: Final[dict[str, tuple[Callable[..., Any], int, int]]] = {
    "min": (min, 2, 16),
    "max": (max, 2, 16),
    "abs": (abs, 1, 1),
    "round": (_rounded, 1, 2),
    "floor": (math.floor, 1, 1),
    "sqrt": (math.sqrt, 1, 1),
    "sin": (math.sin, 1, 1),
    "cos": (math.cos, 1, 1),
    "exp": (math.exp, 1, 1),
    "log": (math.log, 1, 2),
}
"""Functions of formulas by name: the Python function, and the least and the largest number of arguments."""
FUNCTION_NAMES: Final = tuple(_FUNCTIONS)


@dataclass(frozen=True, slots=True)
class Expression:
    """A parsed formula over points and time, from `parse_expression`.

    Attributes:
        text: the formula as it was written.
        names: names of the points that it needs, each once.
    """

    text: str
    names: tuple[str, ...]
    _tree: ast.expr = field(repr=False, compare=False)

    @property
    def words(self) -> frozenset[str]:
        """The words in the formula that do not name points: ``t``, ``pi``."""
        return frozenset(
            each.id for each in ast.walk(self._tree) if isinstance(each, ast.Name) and each.id in (TIME, *_CONSTANTS)
        )

    def bind(self, source: Callable[[str], Callable[[], Number]]) -> BoundExpression:
        """Return a function that evaluates the formula at a time in seconds; it returns NaN where there is no value.

        Args:
            source: called with each point's name, at once and as often as the name occurs in the formula; returns a
                function that reads the point's present value, a number.
        """
        compute = _compiled(self._tree, source)

        def value(time: float) -> float:
            try:
                return float(compute(time))
            except (ArithmeticError, ValueError):
                return math.nan

        return value

    def renamed(self, rename: Callable[[str], str]) -> str:
        """Return the text of the same formula with new names of points, each as ``point("…")``.

        Args:
            rename: returns the new name for the name of a point.
        """
        return ast.unparse(_Renaming(rename).visit(ast.parse(self.text.strip(), mode="eval").body))

    def result(self, values: dict[str, Number]) -> Number:
        """Return the value of the formula for given values of its points and ``t`` = 0.

        Its type is that of Python's arithmetic: ``2 + 2`` is an ``int``, ``4 / 2`` a ``float``, ``2 < 3`` a ``bool``;
        powers are always ``float``.

        Args:
            values: the number of each point in ``names``, by name.

        Raises:
            ConfigError: the formula has no value, or an input or the result is an integer of more than `WHOLE_BITS`
                bits.
        """
        for name in self.names:
            _check_whole(name, values[name])
        try:
            found: Number = _compiled(self._tree, lambda name: lambda: values[name])(0.0)
        except (ArithmeticError, ValueError) as error:
            raise ConfigError(f"{self.text} has no value: {error}") from error
        _check_whole(self.text, found)
        return found


class _Renaming(ast.NodeTransformer):
    """Replaces the names of points in a parsed formula by ``point("…")`` with the new names."""

    def __init__(self, rename: Callable[[str], str]) -> None:
        self._rename = rename

    def visit(self, node: ast.AST) -> Any:  # a node of any kind
        name = _dotted(node) if isinstance(node, ast.expr) else None
        if name is None:
            if isinstance(node, ast.Call):
                node.args = [self.visit(each) for each in node.args]
                return node
            return self.generic_visit(node)
        if isinstance(node, ast.Name) and name in (TIME, *_CONSTANTS):
            return node
        function = ast.Name(_POINT, ast.Load())
        return ast.Call(function, [ast.Constant(self._rename(name))], [])


def _check_whole(what: str, value: Number) -> None:
    if isinstance(value, int) and value.bit_length() > WHOLE_BITS:
        raise ConfigError(f"{shown(what)} has {value.bit_length()} bits, and whole numbers have at most {WHOLE_BITS}")


def parse_expression(text: str) -> Expression:
    """Parse the text of a formula; whether its points exist is not checked.

    Raises:
        ConfigError: the text is no formula, too long or too deeply nested; the error says which.
    """
    if len(text) > _LONGEST:
        raise ConfigError(f"an expression has at most {_LONGEST} characters, not {len(text)}")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        names = tuple(dict.fromkeys(_names(tree, text, 0)))
    except SyntaxError as error:
        near = f" (column {error.offset})" if error.offset else ""
        raise ConfigError(f"{shown(text)} is no expression{near}: {error.msg}") from None
    except (RecursionError, MemoryError):
        raise ConfigError(f"{shown(text)} is no expression: it is nested too deeply") from None
    except ConfigError:  # which is a ValueError too
        raise
    except ValueError as error:
        raise ConfigError(f"{shown(text)} is no expression: {error}") from None
    return Expression(text, names, tree)


def _names(node: ast.expr, text: str, depth: int) -> Iterator[str]:
    """Yield the names of the points in a part of a formula. Raises `ConfigError` for syntax that is not allowed."""
    if depth > _DEEPEST:
        raise ConfigError(f"{shown(text)} is nested too deeply")
    name = _dotted(node)
    if name is not None:
        if not isinstance(node, ast.Name) or name not in (TIME, *_CONSTANTS):
            yield name
        return
    for child in _operands(node, text):
        yield from _names(child, text, depth + 1)


def _operands(node: ast.expr, text: str) -> list[ast.expr]:
    match node:
        case ast.Constant(value=bool() | int() | float()):
            return []
        case ast.BinOp(op=kind) if type(kind) in _BINARY:
            return [node.left, node.right]
        case ast.UnaryOp(op=sign) if type(sign) in _UNARY:
            return [node.operand]
        case ast.BoolOp():
            return node.values
        case ast.Compare() if all(type(each) in _COMPARISONS for each in node.ops):
            return [node.left, *node.comparators]
        case ast.IfExp():
            return [node.test, node.body, node.orelse]
        case ast.Call(func=ast.Name(id=name), keywords=[]):
            return _arguments(name, node.args)
    raise ConfigError(f"{shown(ast.unparse(node))} cannot stand in an expression")


def _arguments(name: str, given: list[ast.expr]) -> list[ast.expr]:
    if name == _POINT:
        raise ConfigError('point takes the name of a point in a text: point("tank level")')
    function = _FUNCTIONS.get(name)
    if function is None:
        raise ConfigError(f"there is no function {shown(name)}; there are {', '.join((*_FUNCTIONS, _POINT))}")
    _, least, most = function
    if not least <= len(given) <= most or any(isinstance(each, ast.Starred) for each in given):
        wanted = f"{least}" if least == most else f"{least}…{most}"
        raise ConfigError(f"{name} takes {wanted} value{'s' if wanted != '1' else ''}, not {len(given)}")
    return given


def _dotted(node: ast.expr) -> str | None:
    """Return the name that a part of a formula consists of; None if the part is no name.

    ``tank.level`` gives "tank.level", ``point("tank level")`` gives "tank level". The caller tells the names of points
    from ``t`` and ``pi``.
    """
    match node:
        case ast.Name():
            return node.id
        case ast.Attribute():
            before = _dotted(node.value)
            return None if before is None else f"{before}.{node.attr}"
        case ast.Call(func=ast.Name(id="point"), args=[ast.Constant(value=str() as name)], keywords=[]):
            return name
    return None


def _compiled(node: ast.expr, source: Callable[[str], Callable[[], Number]]) -> Compute:
    """Return a function of the time that evaluates a part of a formula; its syntax was already checked.

    ``source`` returns for the name of a point the function that reads its value. It is called now, once for each use of
    a name, and not at each evaluation.
    """
    name = _dotted(node)
    if name is not None:
        return _of_name(node, name, source)
    match node:
        case ast.Constant():
            return _constant(node.value)
        case ast.BinOp():
            return _binary(_BINARY[type(node.op)], _compiled(node.left, source), _compiled(node.right, source))
        case ast.UnaryOp():
            change, inner = _UNARY[type(node.op)], _compiled(node.operand, source)
            return lambda time: change(inner(time))
        case ast.BoolOp():
            parts = [_compiled(each, source) for each in node.values]
            decide = all if isinstance(node.op, ast.And) else any
            return lambda time: decide(part(time) for part in parts)
        case ast.Compare():
            return _comparison(node, [_compiled(each, source) for each in (node.left, *node.comparators)])
        case ast.IfExp():
            test, one, other = (_compiled(each, source) for each in (node.test, node.body, node.orelse))
            return lambda time: one(time) if test(time) else other(time)
        case ast.Call(func=ast.Name(id=called)):
            function = _FUNCTIONS[called][0]
            arguments = [_compiled(each, source) for each in node.args]
            return lambda time: function(*(each(time) for each in arguments))
    raise AssertionError(ast.dump(node))


def _of_name(node: ast.expr, name: str, source: Callable[[str], Callable[[], Number]]) -> Compute:
    if isinstance(node, ast.Name):
        if name == TIME:
            return lambda time: time
        if name in _CONSTANTS:
            return _constant(_CONSTANTS[name])
    read = source(name)
    return lambda time: read()


def _constant(value: Any) -> Compute:
    return lambda time: value


def _binary(apply: Callable[[Any, Any], Any], left: Compute, right: Compute) -> Compute:
    return lambda time: apply(left(time), right(time))


def _comparison(node: ast.Compare, values: list[Compute]) -> Compute:
    tests = [_COMPARISONS[type(each)] for each in node.ops]

    def compare(time: float) -> bool:
        found = [each(time) for each in values]
        return all(test(found[at], found[at + 1]) for at, test in enumerate(tests))

    return compare
