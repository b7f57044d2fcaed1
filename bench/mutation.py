"""Mutants of one module: every small change of its code that a test should notice, each tried in a process of its own.

Code runs uncompiled: `stagectl.compiled` is replaced, so that a mutant costs no compiler. A mutant is killed when a
test fails, or takes longer than it may.
"""

import ast
import copy
import functools
import importlib
import inspect
import mmap
import os
import signal
import sys
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
_COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
}
_CALLED = {"min": "max", "max": "min"}
_NOT_TRIED = 3  # an exit code that pytest's results don't use here
_DELETED = (ast.Assign, ast.AugAssign, ast.Raise, ast.Return)


@dataclass(frozen=True)
class Mutant:
    """One change: where, and what became of what."""

    function: str
    line: int
    change: str
    tree: ast.Module
    """Of the module, shared by all its mutants; unchanged but between `apply` and `revert`."""
    node: Any
    field: Any
    kept: Any
    replacement: Any

    def apply(self) -> ast.Module:
        """Make the change."""
        _put(self.node, self.field, self.replacement)
        return self.tree

    def revert(self) -> None:
        """Take it back."""
        _put(self.node, self.field, self.kept)

    @property
    def key(self) -> str:
        """What names it in a list, whatever lines are added elsewhere."""
        return f"{self.function}: {self.change}"


def mutants(source: str) -> list[Mutant]:
    """Return every mutant of a module's functions, constants and defaults; texts and annotations stay as they are."""
    tree = ast.parse(source)
    found: list[Mutant] = []
    counted: dict[str, int] = {}
    for function, node, field, replacement, change in _places(tree):
        kept = getattr(node, field) if isinstance(field, str) else getattr(node, field[0])[field[1]]
        number = counted[f"{function}{change}"] = counted.get(f"{function}{change}", 0) + 1
        said = change if number == 1 else f"{change} (#{number})"
        line = getattr(kept, "lineno", 0)
        found.append(Mutant(function, line, said, tree, node, field, kept, replacement))
    return found


def _put(node: Any, field: Any, value: Any) -> None:
    if isinstance(field, str):
        setattr(node, field, value)
    else:
        getattr(node, field[0])[field[1]] = value


def _places(tree: ast.Module) -> Iterator[tuple[str, Any, Any, Any, str]]:
    """Yield (function, node, field, replacement, change in words) for every place that can be changed."""
    for name, top in _scopes(tree):
        for parent in ast.walk(top):
            for field, value in ast.iter_fields(parent):
                if field in ("annotation", "returns", "decorator_list"):
                    continue
                if isinstance(value, list):
                    for k, item in enumerate(value):
                        if isinstance(item, ast.AST):
                            for replacement, change in _changes(item, parent):
                                yield name, parent, (field, k), replacement, change
                elif isinstance(value, ast.AST):
                    for replacement, change in _changes(value, parent):
                        yield name, parent, field, replacement, change


def _scopes(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, ast.Module(node.body, [])
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef):
                    yield f"{node.name}.{inner.name}", ast.Module(inner.body, [])
                elif _is_default(inner):
                    yield node.name, inner
        elif isinstance(node, ast.Assign) and not isinstance(node.value, ast.Call):
            yield "module", node


def _is_default(node: ast.stmt) -> bool:
    """Tell whether a line of a class gives a field its default."""
    return isinstance(node, ast.AnnAssign) and node.value is not None and not isinstance(node.value, ast.Call)


def _changes(node: ast.AST, parent: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Yield what a node may become."""
    if isinstance(parent, ast.JoinedStr | ast.FormattedValue) or isinstance(node, ast.JoinedStr):
        return
    place = (
        f"in {_said(parent)}: " if isinstance(node, ast.Constant) and isinstance(parent, ast.expr | ast.stmt) else ""
    )
    for new in _new_nodes(node):
        ast.copy_location(new, node)
        ast.fix_missing_locations(new)
        yield new, f"{place}{_said(node)} -> {_said(new)}"
    called = isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant)  # no docstring
    if isinstance(node, ast.stmt) and (called or isinstance(node, _DELETED)):
        yield ast.copy_location(ast.Pass(), node), f"{_said(node)} -> nothing"


def _said(node: ast.AST) -> str:
    """Return the code of an expression, the first line of a statement."""
    return ast.unparse(node).splitlines()[0] if isinstance(node, ast.expr | ast.stmt) else ""


def _new_nodes(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    if isinstance(node, ast.Compare):
        for k, operator in enumerate(node.ops):
            for other in _COMPARED.get(type(operator), ()):
                changed = copy.deepcopy(node)
                changed.ops[k] = other()
                yield changed
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), copy.deepcopy(node.values))
        for k in range(len(node.values)):
            kept = [copy.deepcopy(value) for n, value in enumerate(node.values) if n != k]
            yield kept[0] if len(kept) == 1 else ast.BoolOp(copy.deepcopy(node.op), kept)
    elif isinstance(node, ast.BinOp) and type(node.op) in _COMPUTED:
        yield ast.BinOp(copy.deepcopy(node.left), _COMPUTED[type(node.op)](), copy.deepcopy(node.right))
    elif isinstance(node, ast.AugAssign) and type(node.op) in _COMPUTED:
        yield ast.AugAssign(copy.deepcopy(node.target), _COMPUTED[type(node.op)](), copy.deepcopy(node.value))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield copy.deepcopy(node.operand)
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            yield ast.Constant(not node.value)
        elif isinstance(node.value, int | float):
            yield ast.Constant(node.value + 1)
    elif isinstance(node, ast.IfExp):
        yield copy.deepcopy(node.body)
        yield copy.deepcopy(node.orelse)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id in _CALLED:
            yield ast.Call(ast.Name(_CALLED[node.func.id], ast.Load()), copy.deepcopy(node.args), [])
        elif node.func.id == "abs":
            yield copy.deepcopy(node.args[0])
    elif isinstance(node, ast.If):
        for value in (True, False):
            yield ast.If(ast.Constant(value), copy.deepcopy(node.body), copy.deepcopy(node.orelse))


# ---- running ---------------------------------------------------------------------------------------------------------


class _Fields:
    """A row of a structured array with its fields as attributes, as compiled code has them."""

    def __init__(self, row: Any) -> None:
        object.__setattr__(self, "row", row)

    def __getattr__(self, name: str) -> Any:
        value = self.row[name]
        return value if value.ndim else value.item()

    def __setattr__(self, name: str, value: Any) -> None:
        self.row[name] = value


def uncompiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Run as Python what is written to be compiled."""

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return function(*(_Fields(one) if isinstance(one, np.void) else one for one in arguments))

    return call


@dataclass(frozen=True)
class Trial:
    """Which of the mutants handed in the tests did not notice."""

    alive: tuple[int, ...]
    tests_count: int


def trial(module: str, changed: list[Mutant], tests: list[str], timeout_s: float, say: Callable[[str], None]) -> Trial:
    """Run the tests of a module against each mutant; RuntimeError where they don't pass without any.

    All happens in one forked process that collects the tests once, uncompiled; each mutant is a fork of that, tries the
    quickest tests first, and ends at the first that fails.
    """
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        try:
            with os.fdopen(writer, "w") as out:
                _collect(module, changed, tests, timeout_s, out)
        finally:
            os._exit(0)
    os.close(writer)
    alive, count = [], 0
    with os.fdopen(reader) as found:
        for line in found:
            word, _, value = line.strip().partition(" ")
            if word == "alive":
                alive.append(int(value))
                say(f"survived: {module}:{changed[alive[-1]].line} {changed[alive[-1]].key}")
            elif word == "tests":
                count = int(value)
            elif word == "wrong":
                raise RuntimeError(f"{module}, uncompiled, does not pass {value}; mend that first")
    os.waitpid(pid, 0)
    if not count:
        raise RuntimeError(f"{module}: no test could be collected from {tests}; run them by themselves")
    return Trial(tuple(alive), count)


def _collect(name: str, changed: list[Mutant], tests: list[str], timeout_s: float, out: TextIO) -> None:
    """Import the module, uncompiled where it has compiled code, and collect its tests; `_Session` does the rest.

    One without is taken as it is: what imports it (backends hold the servo's class) is to run its mutants too.
    """
    import pytest

    from stagectl import compiled as compiler

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    module = importlib.import_module(name)
    if "compiled" in vars(module):
        compiler.compiled = uncompiled  # type: ignore[assignment]
        del sys.modules[name]
        module = importlib.import_module(name)
        package, _, last = name.rpartition(".")
        setattr(sys.modules[package], last, module)
    for path in tests:
        sys.modules.pop(path.removesuffix(".py").replace("/", "."), None)
    known = "ignore::pytest.PytestAssertRewriteWarning"  # libraries that the first process has imported
    plugin = _Session(module, changed, timeout_s, out)
    quick = ("-x", "-q", "-p", "no:cacheprovider", "--tb=no", "--assert=plain")  # nobody reads why a mutant died
    pytest.main([*quick, "-W", known, *tests], plugins=[plugin])


class _Session:
    """A plugin that runs what was collected once as it is, and once for each mutant."""

    def __init__(self, module: types.ModuleType, changed: list[Mutant], timeout_s: float, out: TextIO) -> None:
        self.module, self.changed, self.timeout_s, self.out = module, changed, timeout_s, out
        self.failed = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.failed = report.nodeid

    def pytest_runtestloop(self, session: Any) -> bool:
        took_s = {}
        for item in session.items:
            began_s = time.monotonic()
            self._run([item])
            took_s[item] = time.monotonic() - began_s
            if self.failed:
                self._say("wrong", self.failed)
                return True
        items = sorted(session.items, key=lambda item: took_s[item])
        for number, mutant in enumerate(self.changed):
            killer = self._killer(mutant, items)
            if killer is None:
                self._say("alive", number)
            elif killer:
                items.insert(0, items.pop(killer))  # what noticed one change of a line often notices the next
        self._say("tests", len(items))
        return True

    def _say(self, word: str, value: Any) -> None:
        self.out.write(f"{word} {value}\n")
        self.out.flush()

    def _run(self, items: list[Any]) -> int | None:
        """Run tests up to the first that fails; return its place, None where all pass."""
        for k, item in enumerate(items):
            following = items[k + 1] if k + 1 < len(items) else None
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self.failed:
                return k
        return None

    def _killer(self, mutant: Mutant, items: list[Any]) -> int | None:
        """Try a mutant in a fork; return the place of the test that noticed it, 0 too where it never ended."""
        place = mmap.mmap(-1, mmap.PAGESIZE)
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)  # a mutant that never ends is killed by the clock
            signal.setitimer(signal.ITIMER_REAL, self.timeout_s)
            code = _NOT_TRIED
            try:
                put(self.module, mutant.apply(), mutant.function)
                code = 1
                killer = self._run(items)
                place[:4] = (killer or 0).to_bytes(4, "little")
                code = 0 if killer is None else 1
            finally:
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if code == _NOT_TRIED:
            self._say("wrong", f"the mutant {mutant.key} can't be put in its place")
        return None if code == 0 else int.from_bytes(place[:4], "little")


def put(module: types.ModuleType, tree: ast.Module, function: str) -> None:
    """Give a module's function the code that a tree has for it, its constants or a class's defaults their values.

    In place, because tests hold functions and classes that they imported.
    """
    made: dict[str, Any] = dict(module.__dict__)
    if function == "module":
        before = dict(made)
        constants: list[ast.stmt] = [
            node for node in tree.body if isinstance(node, ast.Assign) and not isinstance(node.value, ast.Call)
        ]
        exec(compile(ast.Module(constants, []), str(module.__file__), "exec"), made)
        module.__dict__.update({name: value for name, value in made.items() if before.get(name) is not value})
        return
    exec(compile(tree, str(module.__file__), "exec"), made)
    old: Any = module
    new: Any = types.SimpleNamespace(**{name: made[name] for name in made if name.isidentifier()})
    for name in function.split("."):
        old, new = getattr(old, name), getattr(new, name)
    if isinstance(old, type):  # a dataclass: its defaults are those of the `__init__` that was made for it
        old, new = old.__init__, new.__init__
    if isinstance(old, property):
        old, new = old.fget, new.fget
    old, new = inspect.unwrap(old), inspect.unwrap(new)
    old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, new.__defaults__, new.__kwdefaults__
