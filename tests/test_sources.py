"""The hash that compiled code is kept under: it follows every source that a compiled function can depend on."""

import ast
import subprocess
import sys
from pathlib import Path

from stagectl import sources

ROOT = Path(sources.__file__).parent.parent

# One cycle of a stage with every effect there is, then: which modules hold what was compiled?
HOLDERS = """
import sys
from numba.core.dispatcher import Dispatcher
import stagectl.backlash, stagectl.batch, stagectl.gap.innovations, stagectl.paper.chapters, stagectl.ring
import stagectl.tick, drivers.sample_clock, sim_backend.rig
from stagectl.effects import CATALOGUE
held = [v for m in list(sys.modules.values()) for v in vars(m).values() if issubclass(type(v), Dispatcher)]
held += [known.compiled_law for known in CATALOGUE.values()]
print("\\n".join(sorted({dispatcher.py_func.__module__ for dispatcher in held})))
"""


def test_every_module_with_a_compiled_function_is_in_it():
    said = subprocess.run([sys.executable, "-c", HOLDERS], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    holders = {name for name in said.split() if name.partition(".")[0] in ("stagectl", "sim_backend", "drivers")}
    assert len(holders) > 20
    assert holders <= set(sources.compiled_modules())


def test_what_its_modules_import_is_in_it():
    """Read anew from the syntax: whatever a module of it imports, wherever in the module."""
    inside = set(sources.compiled_modules())
    for name in inside:
        file = ROOT.joinpath(*name.split("."))
        file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{file}: a relative import is not followed"
                imported = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            else:
                continue
            ours = {one for one in imported if _is_module(one)}
            assert ours <= inside, f"{name} imports {ours - inside}"


def test_what_no_tick_can_reach_is_not_in_it():
    inside = set(sources.compiled_modules())
    assert {"stagectl.plant", "stagectl.tick", "stagectl.effects.friction", "stagectl.batch"} <= inside
    assert "stagectl.gap.arbiter" in inside  # its loop is text
    assert not inside & {"stagectl.service.api", "stagectl.page.feed", "stagectl.cli", "stagectl.gap.workflow"}
    assert sources.version() != sources.compiled_version()


def _is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return name.partition(".")[0] in ("stagectl", "sim_backend", "drivers") and (
        path.with_suffix(".py").exists() or (path / "__init__.py").exists()
    )
