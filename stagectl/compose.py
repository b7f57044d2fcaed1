"""Compose a machine or a belief from its effects: a small generated module, cached under a hash.

The module calls the listed effects in a row, by name, with their parameters from one float64 array and their
memories from another, which stands in the plant's state; so its text depends on which effects there are, never
on their values (masking 35 slots instead costs 46 ns a call).
"""

import functools
import hashlib
import importlib.util
import os
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Any

import numpy as np

from stagectl.compiled import CACHE_FOLDER
from stagectl.effects import CATALOGUE, QUANTITIES_OF, Effect
from stagectl.errors import ProfileError
from stagectl.plant import MEMORY_COUNT

_FORCES_HEAD = '''"""Generated: the effects of one machine, called in a row."""
from stagectl import plant
from stagectl.compiled import inlined
from stagectl.effects import CATALOGUE
'''

_ALONG = '''"""Generated: one effect along rows."""
import numpy as np

from stagectl.compiled import compiled
from stagectl.effects import CATALOGUE

law = CATALOGUE[{name!r}].compiled_law{origin}


@compiled
def along(columns, parameters, memory):
    out = np.empty({rows_count})
    if out.size == 0:
        return out
{held}    for k in range(out.size):
        out[k] = law({arguments})
    return out
'''

_HELD = ("mass_kg", "dt_s", "current_loop_s")
"""Quantities that one machine read at one rate has one of: what a law makes of them alone is computed once. A mode's
exponential and its sine, at each of 160 000 rows, were a sixth of a search."""

_COMMANDS = ("macro_command", "micro_command")
_STEP_S, _STEPS = 1e-4, 4000  # of a step response: twenty of the largest time constant

_SUBSTEP = '''

@inlined
def substep(state, parameters, effect_parameters, dt_s, macro_command_a, micro_command_a, macro_bridge, micro_bridge):
    s = state[0]
    q = parameters[0]
    p = effect_parameters
    memory = s.memory
    macro_command_a += macro_command(macro_command_a, q.macro_current_loop_s, s.t_s, dt_s, memory, p)
    micro_command_a += micro_command(micro_command_a, q.micro_current_loop_s, s.t_s, dt_s, memory, p)
    s.left_edge_shift_m = contact_edge(-1.0, s.t_s, memory, p)
    s.right_edge_shift_m = contact_edge(1.0, s.t_s, memory, p)
    plant.half_step(s, q, dt_s, macro_command_a, micro_command_a, macro_bridge, micro_bridge)
    t_s = s.t_s + 0.5 * dt_s
    macro_m = s.middle_macro_position_m
    macro_m_per_s = s.middle_macro_velocity_m_per_s
    macro_m_per_s2 = s.macro_acceleration_m_per_s2
    end_m = s.middle_end_position_m
    end_m_per_s = s.middle_end_velocity_m_per_s
    end_m_per_s2 = s.end_acceleration_m_per_s2
    relative_m = end_m - macro_m
    relative_m_per_s = end_m_per_s - macro_m_per_s
    macro_motor_n = s.macro_force_n
    micro_motor_n = s.micro_force_n
    micro_motor_n += micro_actuator(end_m, end_m_per_s, end_m_per_s2, q.micro_mass_kg, relative_m, relative_m_per_s,
                                    s.micro_current_a, micro_motor_n, micro_motor_n, t_s, dt_s, memory, p)
    macro_motor_n += macro_actuator(macro_m, macro_m_per_s, macro_m_per_s2, q.macro_mass_kg, relative_m,
                                    relative_m_per_s, s.macro_current_a, macro_motor_n, micro_motor_n, t_s, dt_s,
                                    memory, p)
    s.macro_force_n = macro_motor_n
    s.micro_force_n = micro_motor_n
    macro_n = macro_force(macro_m, macro_m_per_s, macro_m_per_s2, q.macro_mass_kg, relative_m, relative_m_per_s,
                          s.macro_current_a, macro_motor_n, micro_motor_n, t_s, dt_s, memory, p)
    micro_n = micro_force(end_m, end_m_per_s, end_m_per_s2, q.micro_mass_kg, relative_m, relative_m_per_s,
                          s.micro_current_a, micro_motor_n, micro_motor_n, t_s, dt_s, memory, p)
    joint_n = joint(relative_m, relative_m_per_s, t_s, dt_s, memory, p)
    contact_n = contact(s.penetration_m, s.penetration_velocity_m_per_s, plant.contact_stiffness(s, q),
                        s.contact_side, t_s, dt_s, memory, p)
    plant.full_step(s, q, dt_s, macro_n - joint_n, micro_n + joint_n, contact_n)


@compiled
def sense(state, parameters, effect_parameters, dt_s):
    """Return what the sensors add to the macro's and the end's position now, m; `dt_s` since the sample before."""
    s = state[0]
    p = effect_parameters
    macro_m = macro_sensor(s.macro_position_m, s.macro_velocity_m_per_s, s.macro_acceleration_m_per_s2, s.t_s, dt_s,
                           s.memory, p)
    if parameters[0].has_micro == 0.0:
        return macro_m, macro_m
    end_m = end_sensor(s.end_position_m, s.end_velocity_m_per_s, s.end_acceleration_m_per_s2, s.t_s, dt_s,
                       s.memory, p)
    return macro_m, end_m


@compiled
def advance(state, parameters, effect_parameters, until_s, longest_s, macro_a, micro_a, macro_bridge, micro_bridge):
    """Advance in equal substeps of at most `longest_s` to exactly `until_s`, commands held."""
    span = until_s - state[0].t_s
    if not span > 0.0:
        return
    count = int(np.ceil(span / longest_s - 1e-9))
    dt_s = span / count
    for _ in range(count):
        substep(state, parameters, effect_parameters, dt_s, macro_a, micro_a, macro_bridge, micro_bridge)
    state[0].t_s = until_s
'''


def _check(effects: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Copy the effect tables; refuse what is not in the catalogue or may not act there."""
    checked: list[dict[str, Any]] = []
    for number, table in enumerate(effects):
        row = dict(table)
        name, place = row.get("name"), row.get("acts_on")
        if name not in CATALOGUE:
            raise ProfileError(f"effects[{number}].name = {name!r} is not an effect; choose from {sorted(CATALOGUE)}")
        known = CATALOGUE[str(name)]
        if place not in known.places:
            raise ProfileError(f"effects[{number}] {name} can't act on {place!r}; it acts on {known.places}")
        if set(row) - {"name", "acts_on"} != set(known.parameters):
            raise ProfileError(f"effects[{number}] {name} takes the parameters {known.parameters}, got {sorted(row)}")
        checked.append(row)
    remembered = sum(CATALOGUE[row["name"]].memory for row in checked)
    if remembered > MEMORY_COUNT:
        raise ProfileError(
            f"effects remember {remembered} numbers, and a machine has room for {MEMORY_COUNT}; remove some"
        )
    return checked


def effect_parameters(effects: Iterable[Mapping[str, Any]]) -> np.ndarray:
    """Return all effect parameters, in the order of the tables and of each effect's declaration."""
    values = [float(row[name]) for row in _check(effects) for name in CATALOGUE[row["name"]].parameters]
    return np.array(values + [0.0], dtype=np.float64)  # one spare: numba dislikes empty arrays


def _forces_source(structure: tuple[tuple[str, str], ...]) -> str:
    """Write one function a place that sums the effects acting there."""
    lines = [_FORCES_HEAD]
    # a law of the user may change under its name: its hash makes another module of it
    lines += [f"effect_{k} = CATALOGUE[{name!r}].compiled_law{_of(name)}" for k, (name, _) in enumerate(structure)]
    parameter, remembered = 0, 0
    calls: dict[str, list[str]] = {place: [] for place in QUANTITIES_OF}
    at_once: dict[str, list[str]] = {place: [] for place in _COMMANDS}
    for k, (name, place) in enumerate(structure):
        known = CATALOGUE[name]
        slots = [f"p[{parameter + j}]" for j in range(len(known.parameters))]
        if known.memory:
            slots.append(f"memory[{remembered}:{remembered + known.memory}]")
        parameter += len(known.parameters)
        remembered += known.memory
        call = f"    total += effect_{k}({', '.join([*known.quantities, *slots])})"
        calls[place].append(call)
        if place in at_once and not known.memory:
            at_once[place].append(call)
    calls |= {f"{place}_at_once": body for place, body in at_once.items()}
    for function, body in calls.items():
        quantities = QUANTITIES_OF[function.removesuffix("_at_once")]
        lines += ["", "", "@inlined", f"def {function}({', '.join(quantities)}, memory, p):", "    total = 0.0"]
        lines += [*body, "    return total"]
    for place, body in at_once.items():
        lines += ["", "", "@inlined", f"def {place}_lost(wanted_a, t_s, dt_s, memory, p):", "    lost_a = 0.0"]
        if body:  # the command that makes up for its own loss: a fixed point, that of a dead band d above d / 1000
            lines += ["    for _ in range(10):"]
            lines += [f"        lost_a = {place}_at_once(wanted_a - lost_a, 0.0, t_s, dt_s, memory, p)"]
        lines += ["    return lost_a"]
    return "\n".join(lines) + "\n"


def _of(name: str) -> str:
    """Return a comment that tells one text of a user's effect from another; empty for those of stagectl."""
    return f"  # {CATALOGUE[name].origin}" if CATALOGUE[name].origin else ""


_ONE_IMPORT = threading.RLock()  # of a thread: generated modules ask for others


def generated_module(name_hint: str, source: str) -> ModuleType:
    """Write `source` once under a hash of it in the cache folder, and import it."""
    with _ONE_IMPORT:  # a module that another thread is importing has no functions yet
        return _imported(_module_name(name_hint, source), source)


def _imported(name: str, source: str) -> ModuleType:
    if name in sys.modules:
        return sys.modules[name]
    path = CACHE_FOLDER / "generated" / f"{name}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != source:
        partial = path.with_suffix(f".{os.getpid()}.part")
        partial.write_text(source)
        partial.replace(path)  # two processes may compose the same machine at once
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ProfileError(f"can't import the generated module {path}; delete the folder {CACHE_FOLDER}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def forget_module(name_hint: str, source: str) -> None:
    """Import a generated module anew where it is next asked for."""
    sys.modules.pop(_module_name(name_hint, source), None)


def _module_name(name_hint: str, source: str) -> str:
    return f"stagectl_generated_{name_hint}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"


def structure_of(effects: Iterable[Mapping[str, Any]]) -> tuple[tuple[str, str], ...]:
    """Return the (name, place) pairs that a generated module depends on."""
    return tuple((row["name"], row["acts_on"]) for row in _check(effects))


def forces_module(structure: tuple[tuple[str, str], ...]) -> ModuleType:
    """Return the module with one compiled function a place (see `stagectl.effects.PLACES`).

    `macro_command_at_once` and `micro_command_at_once` leave out what has a memory: the part that a law can undo.
    `macro_command_lost` and `micro_command_lost` give what that part adds to the command that makes up for it.
    """
    return generated_module("forces", _forces_source(structure))


def command_lag_s(effects: Iterable[Mapping[str, Any]], place: str) -> float:
    """Return by how much the effects with memory at `place` hold a command up: what a unit step loses, s."""
    lost_s = 0.0
    for row in _check(effects):
        known = CATALOGUE[row["name"]]
        if row["acts_on"] == place and known.memory:
            given = {"command_a": 1.0, "current_loop_s": 0.0, "dt_s": _STEP_S}
            rows = np.array([[(given | {"t_s": k * _STEP_S})[key] for key in known.quantities] for k in range(_STEPS)])
            values = np.array([float(row[key]) for key in known.parameters])
            lost_s -= _STEP_S * float(np.sum(along(known)(rows, values, np.zeros(known.memory))))
    return lost_s


def along(known: Effect) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Return a compiled function (columns, parameters, memory) that gives an effect's output row by row.

    columns: float64 (rows, quantities in the order of the declaration); memory is left as the last row leaves it.
    """
    return _along(known.name, _of(known.name), known.quantities, len(known.parameters), known.memory > 0, False)


def along_one_machine(known: Effect) -> Callable[[tuple[np.ndarray, ...], np.ndarray, np.ndarray], np.ndarray]:
    """Return what `along` does, for rows of one mass, one step and one current loop: those of the first row.

    columns: a tuple of float64 arrays (rows,). Put side by side they took a twentieth of a search to copy.
    """
    return _along(known.name, _of(known.name), known.quantities, len(known.parameters), known.memory > 0, True)


@functools.cache
def _along(
    name: str, origin: str, quantities: tuple[str, ...], parameters_count: int, remembers: bool, is_one_machine: bool
) -> Callable[..., np.ndarray]:
    """Return it, composed once: a search asks tens of thousands of times."""
    held, value = (_HELD, "columns[{j}][{k}]") if is_one_machine else ((), "columns[{k}, {j}]")
    arguments = [one if one in held else value.format(k="k", j=j) for j, one in enumerate(quantities)]
    arguments += [f"p{j}" for j in range(parameters_count)]
    arguments += ["memory"] if remembers else []
    taken = [f"    {one} = {value.format(k=0, j=j)}\n" for j, one in enumerate(quantities) if one in held]
    taken += [f"    p{j} = parameters[{j}]\n" for j in range(parameters_count)]
    rows_count = "columns[0].size" if is_one_machine else "columns.shape[0]"
    text = _ALONG.format(
        name=name, origin=origin, rows_count=rows_count, held="".join(taken), arguments=", ".join(arguments)
    )
    return generated_module("along", text).along


def plant_module(effects: Iterable[Mapping[str, Any]]) -> ModuleType:
    """Return the module with compiled `substep` and `advance` of a plant with these effects."""
    forces = forces_module(structure_of(effects))
    source = (
        '"""Generated: the plant of one machine."""\nimport numpy as np\n\nfrom stagectl import plant\n'
        "from stagectl.compiled import compiled, inlined\n"
        f"from {forces.__name__} import {', '.join(QUANTITIES_OF)}\n" + _SUBSTEP
    )
    return generated_module("plant", source)
