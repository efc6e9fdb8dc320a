"""From the modules of steps to one C file.

Only what steps need is understood (``language``), and everything else is refused with its place: what is translated
means the same in both languages, given that integers stay within 64 bits and nothing is divided by zero.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import math
from types import ModuleType
from typing import Any, get_type_hints

from . import numbers, system
from .language import ARRAYS, PREFIX, Bytes, Call, Context, Flags, Floats, Integers, Record, checksum

HEAD = """/* Made by sioms.native.translate; do not edit. */
#define _GNU_SOURCE
#include <math.h>
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>
"""
MATHS = {"sqrt": float, "sin": float, "cos": float, "copysign": float, "exp": float, "expm1": float, "log1p": float,
         "atan2": float, "remainder": float}  # fmt: skip
EXTERNAL = (numbers, system)
ELEMENTS = {Floats: float, Integers: int, Flags: int, Bytes: int}
NUMBERS = {int: "int64_t", float: "double", bool: "int64_t", type(None): "void"}
CALL = "int64_t (*NAME)(void *, int64_t, int64_t, int64_t)"
OPERATORS: dict[type, str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^", ast.LShift: "<<",
    ast.RShift: ">>", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.And: "&&", ast.Or: "||",
}  # fmt: skip


class Untranslatable(Exception):
    """A step uses what steps have not: says where, and what."""


def translate(modules: tuple[str, ...]) -> str:
    """Return the C of all records and steps of some modules.

    Raises:
        Untranslatable: a step uses what steps have not.
    """
    records: list[str] = []
    functions = {
        name: get_type_hints(function)
        for module in EXTERNAL
        for name, function in vars(module).items()
        if inspect.isfunction(function)
    }
    found: list[tuple[ModuleType, ast.FunctionDef]] = []
    for name in modules:
        module = importlib.import_module(name)
        for node in ast.parse(inspect.getsource(module)).body:
            if isinstance(node, ast.ClassDef) and issubclass(vars(module)[node.name], Record):
                records.append(_record(vars(module)[node.name]))
            elif isinstance(node, ast.FunctionDef) and any(ast.unparse(d) == "step" for d in node.decorator_list):
                if node.name in functions:
                    raise Untranslatable(f"{name}:{node.name}: line {node.lineno}: another step has that name")
                functions[node.name] = _hints(module, node)
                found.append((module, node))
    bodies = [_Function(module, node, functions) for module, node in found]
    head = [HEAD, f"const uint32_t sioms_checksum = {checksum()}u;", *(module.C for module in EXTERNAL)]
    return "\n".join([*head, *records, *(f"{b.head};" for b in bodies), "", *(b.text() for b in bodies)])


def _hints(module: ModuleType, node: ast.FunctionDef) -> dict[str, Any]:
    annotations = {a.arg: a.annotation for a in node.args.args} | {"return": node.returns}
    return {n: eval(ast.unparse(a), vars(module)) for n, a in annotations.items() if a is not None}


def _kind(kind: Any) -> str:
    if kind in ARRAYS:
        return str(kind.c)
    if kind is Context:
        return "void *"
    if kind in NUMBERS or kind is None:
        return NUMBERS.get(kind, "void")
    return f"struct {kind.__name__} *"


def _record(cls: type[Record]) -> str:
    fields = "".join(
        f"    {CALL if kind is Call else f'{_kind(kind)} {name}'};\n".replace("NAME", name)
        for name, kind in cls.kinds.items()
    )
    return f"struct {cls.__name__} {{\n{fields}}};"


class _Function:
    """One step."""

    def __init__(self, module: ModuleType, node: ast.FunctionDef, functions: dict[str, Any]) -> None:
        self._module, self._node, self._functions = module, node, functions
        hints = functions[node.name]
        self._kinds = {a.arg: hints[a.arg] for a in node.args.args}
        self._locals: dict[str, Any] = {}
        arguments = ", ".join(f"{_kind(kind)} {name}" for name, kind in self._kinds.items())
        self.head = f"{_kind(hints['return'])} {PREFIX}{node.name}({arguments})"

    def text(self) -> str:
        body = self._block(self._node.body, 1)
        declared = "".join(f"    {_kind(kind)} {name} = 0;\n" for name, kind in self._locals.items())
        return f"{self.head}\n{{\n{declared}{body}}}\n"

    def _refuse(self, node: ast.AST, what: str) -> Untranslatable:
        line = getattr(node, "lineno", 0)
        return Untranslatable(f"{self._module.__name__}:{self._node.name}: line {line}: {what}")

    # -- statements ---------------------------------------------------------------------------

    def _block(self, statements: list[ast.stmt], depth: int) -> str:
        return "".join(self._statement(s, depth) for s in statements)

    def _statement(self, s: ast.stmt, depth: int) -> str:
        pad = "    " * depth
        match s:
            case ast.Expr(value=ast.Constant(value=str())) | ast.Pass():
                return ""
            case ast.Expr(value=ast.Call() as call):
                return f"{pad}{self._expression(call)[0]};\n"
            case ast.Assign(targets=[target], value=value):
                return f"{pad}{self._assign(target, value)};\n"
            case ast.AugAssign(target=target, op=op, value=value):
                read = ast.copy_location(ast.BinOp(_loaded(target), op, value), s)
                return f"{pad}{self._assign(target, read)};\n"
            case ast.If(test=test, body=body, orelse=orelse):
                text = f"{pad}if ({self._truth(test)}) {{\n{self._block(body, depth + 1)}{pad}}}"
                if orelse:
                    text += f" else {{\n{self._block(orelse, depth + 1)}{pad}}}"
                return text + "\n"
            case ast.While(test=test, body=body, orelse=[]):
                return f"{pad}while ({self._truth(test)}) {{\n{self._block(body, depth + 1)}{pad}}}\n"
            case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=args), body=body):
                self._declare(s, name, int)
                bounds = [self._integer(a) for a in args]
                first, last = ("0", bounds[0]) if len(bounds) == 1 else (bounds[0], bounds[1])
                if len(bounds) > 2:
                    raise self._refuse(s, "a range with a stride")
                head = f"for ({name} = {first}; {name} < {last}; {name}++)"
                return f"{pad}{head} {{\n{self._block(body, depth + 1)}{pad}}}\n"
            case ast.Return(value=None):
                return f"{pad}return;\n"
            case ast.Return(value=value) if value is not None:
                return f"{pad}return {self._expression(value)[0]};\n"
            case ast.Break():
                return f"{pad}break;\n"
            case ast.Continue():
                return f"{pad}continue;\n"
        raise self._refuse(s, f"a step has no {type(s).__name__}")

    def _assign(self, target: ast.expr, value: ast.expr) -> str:
        text, kind = self._expression(value)
        if isinstance(target, ast.Name):
            self._declare(target, target.id, kind)
            return f"{target.id} = {text}"
        place, wanted = self._expression(_loaded(target))
        if wanted is int and kind is float:
            raise self._refuse(target, f"{ast.unparse(target)} is an int and is given a float")
        return f"{place} = {text}"

    def _declare(self, node: ast.AST, name: str, kind: Any) -> None:
        known = self._kinds[name] if name in self._kinds else self._locals.setdefault(name, kind)
        if known is not kind:
            raise self._refuse(node, f"{name} is {known.__name__} and is given {kind.__name__}")

    # -- expressions --------------------------------------------------------------------------

    def _integer(self, node: ast.expr) -> str:
        text, kind = self._expression(node)
        if kind is not int:
            raise self._refuse(node, f"{ast.unparse(node)}: want an int")
        return text

    def _truth(self, node: ast.expr) -> str:
        return self._expression(node)[0]

    def _expression(self, node: ast.expr) -> tuple[str, Any]:
        """Return C text and kind of an expression."""
        constant = self._constant(node)
        if constant is not None:
            return constant
        match node:
            case ast.Name(id=name) if name in self._kinds:
                return name, self._kinds[name]
            case ast.Name(id=name) if name in self._locals:
                return name, self._locals[name]
            case ast.Attribute(value=value, attr=attr):
                text, kind = self._expression(value)
                if not (isinstance(kind, type) and issubclass(kind, Record)) or attr not in kind.kinds:
                    raise self._refuse(node, f"{ast.unparse(node)}: no such field")
                return f"{text}->{attr}", kind.kinds[attr]
            case ast.Subscript(value=value, slice=index):
                text, kind = self._expression(value)
                if kind not in ELEMENTS:
                    raise self._refuse(node, f"{ast.unparse(value)} is no array")
                return f"{text}[{self._integer(index)}]", ELEMENTS[kind]
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                text, kind = self._expression(operand)
                return f"(-{text})", kind
            case ast.UnaryOp(op=ast.Invert(), operand=operand):
                return f"(~{self._integer(operand)})", int
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return f"(!{self._truth(operand)})", int
            case ast.BinOp(left=left, op=op, right=right):
                return self._arithmetic(node, op, self._expression(left), self._expression(right))
            case ast.BoolOp(op=op, values=values):
                sign = f" {OPERATORS[type(op)]} "
                return "(" + sign.join(self._truth(v) for v in values) + ")", int
            case ast.Compare(left=left, ops=ops, comparators=others):
                terms = [self._expression(v)[0] for v in (left, *others)]
                pairs = [f"({a} {OPERATORS[type(o)]} {b})" for a, o, b in zip(terms, ops, terms[1:], strict=False)]
                return "(" + " && ".join(pairs) + ")", int
            case ast.IfExp(test=test, body=body, orelse=orelse):
                (a, first), (b, second) = self._expression(body), self._expression(orelse)
                kind = float if float in (first, second) else first
                return f"({self._truth(test)} ? {a} : {b})", kind
            case ast.Call():
                return self._call(node)
        raise self._refuse(node, f"a step has no {ast.unparse(node)}")

    def _constant(self, node: ast.expr) -> tuple[str, Any] | None:
        """Return a number that is written down, or that the module names."""
        if isinstance(node, ast.Constant):
            value = node.value
        elif isinstance(node, ast.Attribute | ast.Name):
            root = node
            while isinstance(root, ast.Attribute):
                root = root.value  # type: ignore[assignment]
            name = getattr(root, "id", "")
            if name in self._kinds or name in self._locals or name not in vars(self._module):
                return None
            value = eval(ast.unparse(node), vars(self._module))
        else:
            return None
        if isinstance(value, bool | int):
            return f"INT64_C({int(value)})", int
        if isinstance(value, float):
            if math.isinf(value):
                return ("(-INFINITY)" if value < 0 else "INFINITY"), float
            return ("NAN" if math.isnan(value) else value.hex()), float
        return None

    def _arithmetic(self, node: ast.expr, op: ast.operator, a: Any, b: Any) -> tuple[str, Any]:
        kind = float if float in (a[1], b[1]) else int
        if isinstance(op, ast.Div):
            return f"((double){a[0]} / (double){b[0]})", float
        sign = OPERATORS.get(type(op))
        if sign is None or (kind is float and sign in ("&", "|", "^", "<<", ">>")):
            raise self._refuse(node, f"a step has no {ast.unparse(node)}")
        return f"({a[0]} {sign} {b[0]})", kind

    def _call(self, node: ast.Call) -> tuple[str, Any]:
        arguments = [self._expression(a) for a in node.args]
        texts = ", ".join(text for text, _ in arguments)
        match node.func:
            case ast.Name(id="abs"):
                kind = arguments[0][1]
                return f"{'fabs' if kind is float else 'llabs'}({texts})", kind
            case ast.Name(id="min" | "max" as name) if len(arguments) == 2:
                kind = float if float in (arguments[0][1], arguments[1][1]) else int
                function = {"min": "lesser", "max": "greater"}[name] + ("" if kind is float else "_int")
                return f"{function}({texts})", kind
            case ast.Name(id="float"):
                return f"((double){texts})", float
            case ast.Name(id="int"):
                return f"((int64_t){texts})", int
            case ast.Attribute(value=ast.Name(id="math"), attr=name) if name in MATHS:
                return f"{name}({texts})", MATHS[name]
            case ast.Attribute() if self._expression(node.func)[1] is Call:
                return f"{self._expression(node.func)[0]}({texts})", int
            case ast.Name(id=name) if name in self._functions:
                return f"{PREFIX}{name}({texts})", self._functions[name]["return"] or int
        raise self._refuse(node, f"a step cannot call {ast.unparse(node.func)}")


def _loaded(target: ast.expr) -> ast.expr:
    """Return a target as what is read."""
    copy = ast.parse(ast.unparse(target), mode="eval").body
    return ast.copy_location(copy, target)
