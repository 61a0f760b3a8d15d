"""Formulas of PEtab's tables and of SBML's MathML, as Python that a declaration may hold.

Nothing is run that a file says: a formula is taken apart, and only names, numbers and known
functions are put together again.
"""

from __future__ import annotations

import ast
import keyword
import math
import operator
from collections.abc import Callable, Mapping
from xml.etree.ElementTree import Element

from casest.errors import DataError

#: What PEtab and SBML call functions of one argument, and what a declaration does.
FUNCTIONS: Mapping[str, Callable[[str], str]] = {
    "exp": lambda x: f"casest.exp({x})",
    "ln": lambda x: f"casest.log({x})",
    "log": lambda x: f"casest.log({x})",
    "log10": lambda x: f"casest.log({x}) / {math.log(10)!r}",
    "sqrt": lambda x: f"casest.sqrt({x})",
    "root": lambda x: f"casest.sqrt({x})",
    "abs": lambda x: f"casest.fabs({x})",
    **{name: lambda x, name=name: f"casest.{name}({x})"  # type: ignore[misc]
       for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
}  # fmt: skip
_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
_COMPUTED = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
             ast.Div: operator.truediv, ast.Pow: operator.pow}  # fmt: skip
_MATHML = {"plus": "+", "times": "*", "minus": "-", "divide": "/", "power": "**"}
#: Names that the written declaration uses itself.
TAKEN = ("casest", "motion", "moved", "per_time", "t", "time")


def name_of(text: str, where: str) -> str:
    """An identifier of a table or a model; DataError where a declaration cannot have it."""
    text = text.strip()
    if not (text.isidentifier() and text.isascii()) or keyword.iskeyword(text) or text in TAKEN:
        raise DataError(f"{where}: {text!r} cannot be a name here; call it otherwise")
    return text


def number_of(text: str) -> float | None:
    """The number that a cell holds; None where it holds something else."""
    try:
        found = float(text)
    except ValueError:
        return None
    return found if math.isfinite(found) else None


def python_of(text: str, where: str) -> str:
    """A formula of a table as Python."""
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError):
        raise DataError(f"{where}: {text!r} is no formula") from None
    return _written(tree, text, where)


def names_in(formula: str) -> set[str]:
    """Names that a written formula reads."""
    called = {"casest"}
    return {n.id for n in ast.walk(ast.parse(formula, mode="eval")) if isinstance(n, ast.Name)} - (
        called
    )


def replaced(formula: str, values: Mapping[str, str]) -> str:
    """The formula with names replaced by other formulas."""
    tree = ast.parse(formula, mode="eval")

    class Replace(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.AST:
            if node.id not in values:
                return node
            return ast.parse(values[node.id], mode="eval").body

    return ast.unparse(Replace().visit(tree))


def value_of(formula: str, values: Mapping[str, float], where: str) -> float:
    """What a written formula comes to; DataError where a name has no number."""
    unknown = names_in(formula) - set(values)
    if unknown:
        raise DataError(f"{where}: {formula} reads {min(unknown)}, which is no number beforehand")
    try:
        return _computed(ast.parse(formula, mode="eval").body, values)
    except (ArithmeticError, ValueError) as error:
        raise DataError(f"{where}: {formula} has no value ({error})") from None


def _computed(node: ast.AST, values: Mapping[str, float]) -> float:
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        return values[node.id]
    if isinstance(node, ast.UnaryOp):
        return -_computed(node.operand, values)
    if isinstance(node, ast.BinOp):
        a, b = (_computed(side, values) for side in (node.left, node.right))
        return float(_COMPUTED[type(node.op)](a, b))
    assert isinstance(node, ast.Call)
    assert isinstance(node.func, ast.Attribute)
    return float(getattr(math, node.func.attr)(_computed(node.args[0], values)))


def _written(node: ast.AST, text: str, where: str) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        return repr(float(node.value))
    if isinstance(node, ast.Name):
        return "t * per_time" if node.id in ("time", "t") else name_of(node.id, where)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        sign = "-" if isinstance(node.op, ast.USub) else ""
        return f"({sign}{_written(node.operand, text, where)})"
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        sides = (_written(side, text, where) for side in (node.left, node.right))
        return f"({f' {_OPERATORS[type(node.op)]} '.join(sides)})"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        arguments = [_written(a, text, where) for a in node.args]
        if node.func.id in FUNCTIONS and len(arguments) == 1:
            return f"({FUNCTIONS[node.func.id](arguments[0])})"
        if node.func.id in ("pow", "power") and len(arguments) == 2:
            return f"({arguments[0]} ** {arguments[1]})"
        raise DataError(
            f"{where}: the function {node.func.id} in {text!r} is not read; there are "
            f"{', '.join(FUNCTIONS)}, pow"
        )
    raise DataError(f"{where}: {text!r} is more than names, numbers, + - * / ^ and functions")


def of_mathml(node: Element, where: str, functions: Mapping[str, tuple[list[str], Element]]) -> str:
    """A formula of SBML as Python; `functions` are those that the model defines."""
    kind = _tag(node)
    if kind in ("math", "semantics"):
        return of_mathml(node[0], where, functions)
    if kind == "cn":
        return _number(node, where)
    if kind == "ci":
        return name_of(node.text or "", where)
    if kind == "csymbol" and str(node.get("definitionURL", "")).endswith("time"):
        return "(t * per_time)"
    if kind in ("pi", "exponentiale"):
        return repr(math.pi if kind == "pi" else math.e)
    if kind != "apply":
        raise DataError(f"{where}: MathML's {kind} is not read")
    return _applied(node, where, functions)


def _applied(node: Element, where: str, functions: Mapping[str, tuple[list[str], Element]]) -> str:
    what = node[0]
    kind = _tag(what)
    beside = [child for child in node[1:] if _tag(child) not in ("degree", "logbase")]
    given = [of_mathml(child, where, functions) for child in beside]
    if kind == "ci":
        called = (what.text or "").strip()
        if called not in functions or len(functions[called][0]) != len(given):
            raise DataError(f"{where}: calls {called}, which the model does not define so")
        names, body = functions[called]
        inner = of_mathml(body, where, functions)
        return f"({replaced(inner, dict(zip(names, given, strict=True)))})"
    if kind == "minus" and len(given) == 1:
        return f"(-{given[0]})"
    if kind in _MATHML and given:
        return f"({f' {_MATHML[kind]} '.join(given)})"
    other = len(beside) != len(node) - 1  # a logarithm, or a root, of another base
    if kind in FUNCTIONS and len(given) == 1 and (not other or kind == "log"):
        return f"({FUNCTIONS['log10' if kind == 'log' else kind](given[0])})"
    raise DataError(f"{where}: MathML's {kind} is not read")


def _number(node: Element, where: str) -> str:
    parts = [node.text or "", *(child.tail or "" for child in node)]
    kind = node.get("type", "real")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        raise DataError(f"{where}: {' '.join(parts)!r} is no number") from None
    if kind == "e-notation":
        return repr(float(f"{parts[0].strip()}e{parts[1].strip()}"))
    return repr(values[0] / values[1]) if kind == "rational" else repr(values[0])


def _tag(node: Element) -> str:
    return node.tag.rpartition("}")[2]
