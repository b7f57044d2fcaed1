"""Writes blind sets: what a user would hand over, and the truth somewhere else.

    python -m tests.blind.generate --seed 1 --count 10 --out sets [--truth sealed] [--kind single] [--seconds 20]

A set's folder holds `run_<i>.csv`, `runs.toml` and `modeller.toml`; the truth goes to `<truth>/<seed>/truth.json`.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np

from tests.blind import detection
from tests.blind.detection import judged
from tests.blind.draw import KINDS, Case, draw
from tests.blind.machine import BASE, CONTROL, SAMPLE_S, B, C

__all__ = ["Case", "draw", "truth", "write"]

DEVELOPMENT_SEEDS = (1, 9_999)
FINAL_SEEDS = (1_000_000, 1_999_999)


def columns(case, run):
    """{column: values} of a run as recorded."""
    n = len(run.samples)
    result = {"t_s": np.arange(n) * SAMPLE_S, "reference_m": run.reference[:, 0]}
    if not case.single:
        result["relative_reference_m"] = run.relative[:, 0]
    result["macro_position_m"] = run.readings[:, 0]
    if not case.single:
        result["end_position_m"] = run.readings[:, 1]
    for place, axis in enumerate(("macro",) if case.single else ("macro", "micro")):
        force = run.samples[:, 2 + place]
        if case.command_in_amperes:
            result[f"{axis}_command_a"] = force / run.control[C["macro_force_constant_n_per_a"] + place]
        else:
            result[f"{axis}_command_n"] = force
    for place, axis in enumerate(("macro",) if case.single else ("macro", "micro")):
        quantum = case.current_quantum_a[place]
        measured = run.samples[:, 4 + place] + run.current_noise[:, place]
        result[f"{axis}_current_a"] = np.round(measured / quantum) * quantum
    return result


FORMATS = {"t_s": "%.6f", "reference_m": "%.15f", "relative_reference_m": "%.15f"}


def _format(name):
    if name in FORMATS:
        return FORMATS[name]
    if name.endswith("position_m"):
        return "%.10f"
    return "%.9f" if "command" in name else "%.5f"


def _toml(value):
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if not math.isfinite(value):
        raise ValueError(f"{value} can't be stated")
    return repr(float(value))


def _table(name, values, array=False):
    head = f"[[{name}]]" if array else f"[{name}]"
    return "\n".join([head, *(f"{key} = {_toml(value)}" for key, value in values.items()), ""])


def runs_text(case):
    """runs.toml: how each run was made."""
    parts = []
    for run in case.runs:
        gains = {name: run.control[C[name]] for name in CONTROL if not (case.single and name.startswith("micro"))}
        values = {
            "file": f"run_{run.number}.csv",
            "homing_id": run.homing,
            "payload_kg": run.payload_kg,
            "payload_on": "macro" if case.single else "end",
            "starts_at_session_s": run.start_s,
        }
        parts.append(_table("runs", values, array=True) + _table("runs.gains", gains))
    return "\n".join(parts)


STRUCTURE = """\
# Every run starts at rest on its reference as the loop closes: integrals and filtered speeds zero, the last reading the
# first. At sample k, T = rate_s: speed and acceleration of a reference are its central differences; before the first
# sample it stands, after the last it goes on along a line. Each axis:
#   filtered += (1 - exp(-2 pi filter_hz T)) ((reading - last reading) / T - filtered)
#   miss = reference speed + position_gain (reference - reading) - filtered;  integral += integral_gain T miss
#   force = velocity_gain (miss + integral) + feed-forward, then cut at its limit
# Micro first: its reading is end_position, its feed-forward acceleration_feedforward a(reference)
#   + spring_feedforward relative_reference.
# Macro: its reference is reference - relative_reference, its feed-forward acceleration_feedforward a
#   + velocity_feedforward v - spring_feedforward relative_reference + reaction_decoupling x micro command.
# Command in A = force / force constant of the gains table. It is held for T, acts command_delay later, and the current
# follows through a first-order lag current_lag. Reported currents are those at the sample.
# Plant, r = end - macro: spring_stiffness r + spring_damping r' pulls the macro forward and the end back; stops beyond
# r = right_edge and r = -left_edge: stiffness x depth + contact_damping x rate of depth, never pulling.
# The micro drive pushes the end stage and, times micro_reaction, the macro axis backwards. macro_damping: to the base.
"""


def modeller_text(case):
    """modeller.toml: what is believed, and how well."""
    stage = {"axes": "single" if case.single else "macro_micro", "rate_s": SAMPLE_S, "held_command": "zero_order"}
    sensors = {"macro_position_noise_m": case.sensor_noise_m[0], "macro_current_noise_a": case.current_noise_a[0]}
    sensors["macro_current_quantum_a"] = case.current_quantum_a[0]
    if not case.single:
        sensors |= {"end_position_noise_m": case.sensor_noise_m[1], "micro_current_noise_a": case.current_noise_a[1]}
        sensors["micro_current_quantum_a"] = case.current_quantum_a[1]
    sensors["position_quantum_m"] = detection.SENSOR_QUANTUM_M
    known = [name for name in case.belief if not (case.single and name == "micro_reaction")]
    return "\n".join(
        [
            STRUCTURE,
            _table("stage", stage),
            _table("values", {name: case.belief[name] for name in known}),
            _table("standard_deviations", {name: case.uncertainty[name] for name in known}),
            _table("sensors", sensors),
        ]
    )


def _found(found):
    return {
        "d_prime": found.d_prime,
        "limit": found.limit if math.isfinite(found.limit) else None,
        "above_twice_limit": found.above_twice,
        "above_ten_times_limit": found.above_ten_times,
        "inseparable": [list(key) for key in found.inseparable],
        "nearest": [[*key, value] for key, value in sorted(found.nearest.items(), key=lambda item: item[1])[:6]],
    }


def truth(case, separate=True):
    """The sealed truth of a case as plain values."""
    found, wrong = judged(case, separate)
    effects = []
    for effect, one in zip(case.effects, found, strict=True):
        effects.append(
            {
                "name": effect.law.name,
                "acts_on": effect.acts_on,
                "both_axes": effect.law.both_axes,
                "outside": effect.law.outside,
                "amplitude": effect.law.parameters[0].name,
                "parameters": effect.values,
                **_found(one),
            }
        )
    parameters = []
    for (name, acts_on), size in case.parameter_errors.items():
        parameters.append(
            {"name": name, "acts_on": acts_on, "error_in_standard_deviations": size, **_found(wrong[name, acts_on])}
        )
    return {
        "seed": case.seed,
        "kind": case.kind,
        "single_axis": case.single,
        "runs": [{"recipe": run.recipe, "homing_id": run.homing, "payload_kg": run.payload_kg} for run in case.runs],
        "base": {name: float(case.base[B[name]]) for name in BASE},
        "sensor_noise_m": list(case.sensor_noise_m),
        "effects": effects,
        "parameter_errors": parameters,
    }


def write(case, folder, sealed=None, separate=True):
    """Writes the set to `folder` and, where given, its truth to `sealed`, which must lie elsewhere."""
    folder = Path(folder)
    if sealed is not None and Path(sealed).resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"the truth's folder {sealed} lies inside the set's folder {folder}: choose another")
    folder.mkdir(parents=True, exist_ok=True)
    for run in case.runs:
        table = columns(case, run)
        row = ",".join(_format(name) for name in table) + "\n"
        values = np.column_stack(list(table.values()))
        text = (row * len(values)) % tuple(values.ravel())
        (folder / f"run_{run.number}.csv").write_text(",".join(table) + "\n" + text)
    (folder / "runs.toml").write_text(runs_text(case))
    (folder / "modeller.toml").write_text(modeller_text(case))
    if sealed is not None:
        sealed = Path(sealed)
        sealed.mkdir(parents=True, exist_ok=True)
        (sealed / "truth.json").write_text(json.dumps(truth(case, separate), indent=1))


def main(arguments=None):
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.blind.generate", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument(
        "--seed", type=int, required=True, help="first seed: 1..9999 to develop, 1000000.. for the final"
    )
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, help="folder of the sealed truth; OUT-truth where absent")
    parser.add_argument("--kind", choices=sorted(KINDS))
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a run")
    given = parser.parse_args(arguments)
    sealed = given.truth or given.out.with_name(given.out.name + "-truth")
    for seed in range(given.seed, given.seed + given.count):
        start = time.monotonic()
        case = draw(seed, given.kind, given.seconds)
        write(case, given.out / str(seed), sealed / str(seed))
        print(f"{seed}: {len(case.runs)} runs, {time.monotonic() - start:.1f} s")


if __name__ == "__main__":
    main()
