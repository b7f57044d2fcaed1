"""A user's own effects, from the text of a Python file to the catalogue: read, declared, compiled and tried.

The text may compute and nothing else: it comes back out of the records of runs, which may be other people's. Pure but
for the folder of compiled code.
"""

import ast
import builtins
import hashlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numba.core.errors import NumbaError

from stagectl import compose
from stagectl.effects import CATALOGUE, Effect
from stagectl.errors import ProfileError

_IMPORTS = {"numpy": None, "math": None, "stagectl.effects": {"effect"}, "stagectl.compiled": {"compiled"}}
"""What may be imported: a module as a whole, or these names of it."""

_BUILTINS = frozenset(("abs", "bool", "float", "int", "len", "max", "min", "range", "round"))
_ARRAYS = frozenset(("arange", "array", "clip", "interp", "linspace", "ones", "where", "zeros"))

# fmt: off
_NODES = (
    ast.AnnAssign, ast.Assign, ast.Attribute, ast.AugAssign, ast.BinOp, ast.BoolOp, ast.Break, ast.Call, ast.Compare,
    ast.Constant, ast.Continue, ast.Expr, ast.For, ast.FunctionDef, ast.If, ast.IfExp, ast.Import, ast.ImportFrom,
    ast.List, ast.Module, ast.Name, ast.Pass, ast.Return, ast.Slice, ast.Subscript, ast.Tuple, ast.UnaryOp, ast.While,
    ast.alias, ast.arg, ast.arguments, ast.boolop, ast.cmpop, ast.expr_context, ast.keyword, ast.operator, ast.unaryop,
)
"""What a text may be made of."""
# fmt: on

_FAILURES = (ArithmeticError, AttributeError, LookupError, MemoryError, NameError, TypeError, ValueError, NumbaError)
_MOTIONS = (0.0, 1e-3, -0.2)  # of every quantity that is not positive by nature
_POSITIVE = {"mass_kg": 10.0, "contact_stiffness_n_per_m": 1e7}
_LINEAR_RATIO = 1e-9


def declare(text: str, title: str) -> tuple[str, ...]:
    """Put the effects of a text into the catalogue; returns their names.

    The same text again changes nothing. Errors: ProfileError, which says what is wrong with the text and where.
    """
    tree = _parsed(text, title)
    origin = hashlib.sha256(text.encode()).hexdigest()[:16]
    names = _declared_names(tree)
    if not names:
        raise ProfileError(f"{title} declares no effect; write @effect(...) above a function")
    if all(name in CATALOGUE and CATALOGUE[name].origin == origin for name in names):
        return names
    for name in names:
        if name in CATALOGUE:
            whose = "stagectl's own" if not CATALOGUE[name].origin else "one of another text in this process"
            raise ProfileError(f"{title}: {name} is the name of an effect already, {whose}; rename yours")
    before = set(CATALOGUE)
    compose.forget_module("effects", text)  # its declarations are made by its import
    try:
        compose.generated_module("effects", text)
        found = [CATALOGUE[name] for name in CATALOGUE if name not in before]
        for known in found:
            _try(known, title)
            CATALOGUE[known.name] = replace(known, origin=origin)
    except _FAILURES as error:
        _forget(before, text)
        raise ProfileError(f"{title}: {_first_lines(error)}") from error
    except ProfileError:
        _forget(before, text)
        raise
    return names


def _forget(before: set[str], text: str) -> None:
    for name in [name for name in CATALOGUE if name not in before]:
        del CATALOGUE[name]
    compose.forget_module("effects", text)


def _parsed(text: str, title: str) -> ast.Module:
    """Parse a text and refuse whatever could do more than compute."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ProfileError(f"{title} is not Python: {error}") from error
    modules = {
        alias.asname or alias.name: alias.name
        for node in tree.body
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    for node, is_top in _walk(tree):
        problem = _problem(node, modules, is_top)
        if problem:
            line = getattr(node, "lineno", 1)
            raise ProfileError(f"{title} line {line}: {problem}; the file of an effect may compute and nothing else")
    return tree


def _walk(tree: ast.Module) -> Iterator[tuple[ast.AST, bool]]:
    """Yield every node, and whether it is a statement of the file itself."""
    top = {id(node) for node in tree.body}
    return ((node, id(node) in top or node is tree) for node in ast.walk(tree))


def _problem(node: ast.AST, modules: dict[str, str], is_top: bool) -> str:
    """Say what is wrong with one node; empty where nothing is."""
    match node:
        case ast.Import():
            strange = [alias.name for alias in node.names if alias.name not in ("numpy", "math")]
            return f"imports {strange[0]}, and may import numpy and math" if strange else _inner("import", is_top)
        case ast.ImportFrom():
            allowed = _IMPORTS.get(node.module or "") or set()
            strange = [alias.name for alias in node.names if alias.name not in allowed]
            said = (
                f"takes {strange[0]} from {node.module}, and may take effect from stagectl.effects" if strange else ""
            )
            return said or _inner("import", is_top)
        case ast.FunctionDef():
            if node.args.vararg or node.args.kwarg or node.args.kwonlyargs:
                return f"{node.name} takes its arguments by * or by name, and an effect is called positionally"
            if any(not isinstance(_called(one), ast.Name) for one in node.decorator_list):
                return f"{node.name} has a decorator that is neither effect nor compiled"
            names = {_called(one).id for one in node.decorator_list}  # pyright: ignore[reportAttributeAccessIssue]
            if not names or names - {"effect", "compiled"}:
                return f"{node.name} needs the decorator effect, or compiled for a function that effects call"
            return _inner("function", is_top)
        case ast.Name():
            return _name_problem(node, modules)
        case ast.Attribute():
            if not isinstance(node.value, ast.Name) or node.value.id not in modules:
                return f"asks for .{node.attr} of something that is no module"
            return "" if _computes(modules[node.value.id], node.attr) else f"{node.value.id}.{node.attr} is not allowed"
        case ast.keyword(arg=None):
            return "** hides what is declared"
        case _ if not isinstance(node, _NODES):
            return f"{type(node).__name__} is not allowed"
        case _ if is_top and not isinstance(node, ast.Module | ast.Assign | ast.AnnAssign | ast.Expr):
            return f"{type(node).__name__} outside a function is not allowed"
    return ""


def _inner(what: str, is_top: bool) -> str:
    return "" if is_top else f"{what} inside of something else is not allowed"


def _called(decorator: ast.expr) -> ast.expr:
    return decorator.func if isinstance(decorator, ast.Call) else decorator


def _name_problem(node: ast.Name, modules: dict[str, str]) -> str:
    if node.id.startswith("__") or (hasattr(builtins, node.id) and node.id not in _BUILTINS):
        return f"{node.id} is not allowed"
    if node.id in modules and isinstance(node.ctx, ast.Store):
        return f"{node.id} is a module"
    return ""


def _computes(module: str, attribute: str) -> bool:
    """Tell whether a name of numpy or math is a number or a function of numbers."""
    if module == "math":
        return not attribute.startswith("_") and hasattr(math, attribute)
    return attribute in _ARRAYS or isinstance(getattr(np, attribute, None), np.ufunc | float)


def _declared_names(tree: ast.Module) -> tuple[str, ...]:
    return tuple(
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(one, ast.Call) and getattr(one.func, "id", "") == "effect" for one in node.decorator_list)
    )


def _try(known: Effect, title: str) -> None:
    """Compile one effect and hold it to its declaration. Errors: ProfileError, or what its text raises."""
    if "pitch_m" in known.parameters and (strange := [n for n in known.shape if n != "pitch_m"]):
        raise ProfileError(f"{title}: {known.name} has a pitch_m beside {strange[0]}; call it period_m")
    sides = [known.bounds[name] for name in known.parameters]
    for share in (0.0, 0.5, 1.0):
        values = [low + share * (high - low) for low, high in sides]
        for motion in _MOTIONS:
            found = _output(known, motion, values)
            if not isinstance(found, float):
                raise ProfileError(f"{title}: {known.name} returns {type(found).__name__}, and must return a float")
            if not math.isfinite(found):
                at = ", ".join(f"{name} = {value:g}" for name, value in zip(known.parameters, values, strict=True))
                where = "with every quantity zero" if motion == 0.0 else f"with every quantity {motion:g}"
                raise ProfileError(f"{title}: {known.name} gives {found} {where}, {at}; guard it, or narrow its bounds")
    _try_linear(known, title)
    if known.memory:
        memory = np.full(known.memory, 0.25)
        _output(known, 1e-3, [0.5 * (low + high) for low, high in sides], 0.0, memory)
        if np.any(memory != 0.25):
            raise ProfileError(f"{title}: {known.name} changes its memory with dt_s = 0; advance it by dt_s only")


def _try_linear(known: Effect, title: str) -> None:
    """Hold an effect to what it says it is linear in: the gap workflow solves for those."""
    middle = {name: 0.5 * (low + high) for name, (low, high) in known.bounds.items()}
    for motion in _MOTIONS[1:]:
        alone = [
            middle | dict.fromkeys(known.linear, 0.0) | {name: 1.0 if known.bounds[name][1] >= 1.0 else middle[name]}
            for name in known.linear
        ]
        for number, one in enumerate(alone):
            name = known.linear[number]
            once = _output(known, motion, list(one.values()))
            twice = _output(known, motion, list((one | {name: 2.0 * one[name]}).values()))
            if not abs(twice - 2.0 * once) <= _LINEAR_RATIO * abs(once):
                raise ProfileError(f"{title}: {known.name} is not linear in {name}, as it declares")


def _output(
    known: Effect, motion: float, values: list[float], dt_s: float = 1e-4, memory: np.ndarray | None = None
) -> float:
    """Call the compiled law with every quantity at one value."""
    given = _POSITIVE | {"dt_s": dt_s, "t_s": abs(motion), "penetration_m": 1e-3 * abs(motion)}
    quantities = [given.get(name, motion) for name in known.quantities]
    remembered = [np.zeros(known.memory) if memory is None else memory] if known.memory else []
    return known.compiled_law(*quantities, *values, *remembered)


def _first_lines(error: BaseException) -> str:
    """Return the part of an error that a person needs: compilers say much."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    kind = "numba can't compile it: " if isinstance(error, NumbaError) else ""
    return kind + " ".join(itertools.islice(lines, 3))
