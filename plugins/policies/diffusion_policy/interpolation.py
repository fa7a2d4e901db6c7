"""Values of a configuration that are still written as ``${...}``.

A saved configuration is normally resolved; forks leave ``${a.b}`` and ``${eval:'...'}`` strings. These two forms are
worked out here, lazily: a key that is never asked for may hold anything. ``eval`` means a small language of numbers,
comparisons and if/else, read with ``ast`` and evaluated by hand; Python's ``eval`` is never called.
"""

import ast
import itertools
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ttscompile.errors import CheckpointError

_REFERENCE = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+|\[\d+\])*)\}")
_EVAL = re.compile(r"\$\{eval:\s*(?:'([^']*)'|\"([^\"]*)\"|([^'\"]*))\s*\}", re.DOTALL)
_LONGEST = 1000  # characters of an expression
_LARGEST = 1e15  # magnitude of any number in it, so that no expression can take long
_MOST_VALUES = 100_000  # that one key may resolve to: references to lists of references grow without bound
_LONGEST_TEXT = 100_000  # characters of a resolved text, for the same reason

_OPERATORS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def _refuse(why: str) -> CheckpointError:
    return CheckpointError(
        f"{why}; expected numbers, True, False, None, + - * / // %, comparisons, and/or/not, and 'a if b else c'"
    )


def _number(value: Any) -> Any:
    if not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
        raise _refuse(f"{value!r} is not a number below {_LARGEST:g}")
    return value


def _evaluate(node: ast.AST) -> Any:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() | None):
            return node.value
        case ast.UnaryOp() if type(node.op) in _OPERATORS:
            operand = _evaluate(node.operand)
            return _OPERATORS[type(node.op)](operand if isinstance(node.op, ast.Not) else _number(operand))
        case ast.BinOp() if type(node.op) in _OPERATORS:
            left, right = _number(_evaluate(node.left)), _number(_evaluate(node.right))
            return _number(_OPERATORS[type(node.op)](left, right))
        case ast.Compare() if all(type(op) in _OPERATORS for op in node.ops):
            values = [_evaluate(side) for side in (node.left, *node.comparators)]
            pairs = zip(node.ops, values, values[1:], strict=False)
            return all(_OPERATORS[type(op)](left, right) for op, left, right in pairs)
        case ast.BoolOp():
            wanted = isinstance(node.op, ast.Or)
            value: Any = None
            for part in node.values:
                value = _evaluate(part)
                if bool(value) is wanted:
                    break
            return value
        case ast.IfExp():
            return _evaluate(node.body if _evaluate(node.test) else node.orelse)
        case _:
            raise _refuse(f"{ast.unparse(node)!r} is not allowed")


def evaluate_expression(text: str) -> Any:
    """Value of a small arithmetic expression, as in ``${eval:'2 if True else 2 + 20'}``."""
    if len(text) > _LONGEST:
        raise _refuse(f"the expression has {len(text)} characters, more than {_LONGEST}")
    try:
        return _evaluate(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, TypeError, ArithmeticError, RecursionError, MemoryError) as error:
        raise _refuse(f"{text!r} has no value ({error})") from error


@dataclass(frozen=True)
class Config:
    """A configuration whose values are resolved when they are asked for.

    Attributes:
        tree: nested dictionaries, lists and scalars (``plain_config``).
    """

    tree: Mapping[str, Any]

    def get(self, key: str, default: Any = None) -> Any:
        """The resolved value at a dotted key, ``default`` where there is none."""
        found, value = self._find(key)
        return self._resolve(value, key, (), itertools.count()) if found else default

    def require(self, key: str) -> Any:
        """The resolved value at a dotted key."""
        if not self._find(key)[0]:
            raise CheckpointError(f"cfg.{key} is missing from the checkpoint's configuration; it is needed.")
        return self.get(key)

    def _find(self, key: str) -> tuple[bool, Any]:
        value: Any = self.tree
        for part in re.findall(r"\w+", key):
            if isinstance(value, Mapping) and part in value:
                value = value[part]
            elif isinstance(value, list) and part.isdigit() and int(part) < len(value):
                value = value[int(part)]
            else:
                return False, None
        return True, value

    def _resolve(self, value: Any, key: str, seen: tuple[str, ...], values: Iterator[int]) -> Any:
        if next(values) > _MOST_VALUES:
            raise CheckpointError(f"cfg.{key} refers to more than {_MOST_VALUES} values; it is malformed.")
        if isinstance(value, Mapping):
            return {name: self._resolve(item, f"{key}.{name}", seen, values) for name, item in value.items()}
        if isinstance(value, list):
            return [self._resolve(item, f"{key}[{i}]", seen, values) for i, item in enumerate(value)]
        if value == "???":
            raise CheckpointError(f"cfg.{key} is '???', which was never given; set it and save the checkpoint again.")
        if isinstance(value, str) and "${" in value:
            return self._interpolate(value, key, seen, values)
        return value

    def _interpolate(self, text: str, key: str, seen: tuple[str, ...], values: Iterator[int]) -> Any:
        """Resolve one string: a lone reference keeps its type, references inside other text become text."""
        if key in seen:
            raise CheckpointError(f"cfg.{key} refers to itself: {' -> '.join((*seen, key))}.")
        seen = (*seen, key)

        def look_up(reference: re.Match[str]) -> Any:
            target = reference.group(1)
            found, value = self._find(target)
            if not found:
                raise CheckpointError(f"cfg.{key} is {text!r}, and the configuration has no key {target!r}.")
            return self._resolve(value, target, seen, values)

        lone = _REFERENCE.fullmatch(text)
        if lone:
            return look_up(lone)
        replaced = _REFERENCE.sub(lambda reference: str(look_up(reference)), text)
        if len(replaced) > _LONGEST_TEXT:
            raise CheckpointError(f"cfg.{key} is longer than {_LONGEST_TEXT} characters; it is malformed.")
        expression = _EVAL.fullmatch(replaced)
        if expression:
            try:
                return evaluate_expression(next(group for group in expression.groups() if group is not None))
            except CheckpointError as error:
                raise CheckpointError(f"cfg.{key} is {text!r}: {error}. Resolve it before saving.") from error
        if "${" in replaced:
            raise CheckpointError(
                f"cfg.{key} is {text!r}, which only the training code can resolve; expected a plain value, ${{a.b}} or"
                " ${eval:'...'} of numbers. Call OmegaConf.resolve(cfg) before saving."
            )
        return replaced
