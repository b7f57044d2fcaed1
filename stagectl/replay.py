"""Replay: a run's raw bytes through the same decoder and ticks again, compared bit for bit.

Starts from the snapshot at the run's beginning; rows give bytes, times and setpoints, events give every change from
outside. On the same versions and CPU family every measurement and command must come out identical.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.arming import DriveMapping
from drivers.pdo import Codec
from drivers.wire import Inbox, WireDecoder
from stagectl.errors import LinkError, RecordError
from stagectl.fields import fields
from stagectl.plant import PLANT_PARAMETERS
from stagectl.record import MANIFEST, SNAPSHOT, Run, read_run
from stagectl.requests import TICKING, Phase
from stagectl.runs import missing_text, profile_of
from stagectl.signals import COMMAND, MEASUREMENT, SETPOINT
from stagectl.tracker import Tracker

_FROM_OUTSIDE = ("lease_left_ns", "overrun_ns", "command_lost")
_TICKING = tuple(int(phase) for phase in TICKING)


@dataclass(frozen=True, slots=True)
class Comparison:
    """What a replay found."""

    rows: int
    ticks: int
    differing_rows: int
    first_difference: str  # empty where there is none
    greatest_force_difference_n: float

    @property
    def exact(self) -> bool:
        """Whether every replayed value equals the recorded one, bit for bit."""
        return self.differing_rows == 0


def describe_mapping(mapping: DriveMapping) -> dict[str, Any]:
    """Turn a mapping into JSON for the manifest."""
    return {
        "node_id": mapping.node_id,
        "rpdo": [entry.word for entry in mapping.rpdo.entries],
        "tpdo": [entry.word for entry in mapping.tpdo.entries],
        "inputs_tpdo": [entry.word for entry in mapping.inputs_tpdo.entries],
        "rpdo_id": mapping.rpdo_id,
        "tpdo_id": mapping.tpdo_id,
        "inputs_id": mapping.inputs_id,
        "emcy_id": mapping.emcy_id,
    }


def mapping_of(table: Mapping[str, Any]) -> DriveMapping:
    """Make a mapping from the manifest's JSON."""
    values: dict[str, Any] = {name: Codec.from_mapping(table[name]) for name in ("rpdo", "tpdo", "inputs_tpdo")}
    values |= {name: int(table[name]) for name in ("node_id", "rpdo_id", "tpdo_id", "inputs_id", "emcy_id")}
    return DriveMapping(**values)


def mappings_of(run: Run) -> dict[str, DriveMapping]:
    """Make the mappings of a run's drives. Errors: RecordError."""
    try:
        return {axis: mapping_of(table) for axis, table in run.manifest["mappings"].items()}
    except (KeyError, TypeError, ValueError, LinkError) as error:
        raise RecordError(
            f"{run.folder / MANIFEST}: mappings are damaged ({type(error).__name__}: {error}); "
            "take the file from a copy of the run"
        ) from error


def replay(folder: str | Path) -> Comparison:
    """Replay a run folder; RecordError where it lacks what a replay needs, rows that the manifest counts included."""
    run = read_run(Path(folder))
    if run.rows_missing_count:
        missing = missing_text(run.rows_missing_count, run.rows_missing_count + len(run.rows))
        raise RecordError(f"{run.folder}: {missing}; nothing to replay as a whole: take the file from a copy")
    return replay_run(run)


def replay_run(run: Run) -> Comparison:
    """Replay a run that was read, or as many of its rows as are given."""
    manifest = run.manifest
    if "mappings" not in manifest or not run.snapshot:
        raise RecordError(
            f"{run.folder}: the run has no raw bytes to start from (imported table, value seam, or a lost "
            f"{SNAPSHOT}); nothing to replay"
        )
    if not run.rows.size:
        raise RecordError(
            f"{run.folder}: the run has no rows, so nothing to replay; `stagectl runs show` says how it ended"
        )
    profile = profile_of(run)
    mappings = mappings_of(run)
    decoder = WireDecoder(profile, mappings)
    decoder.restore(run.snapshot)
    tracker = Tracker(profile, has_drives=True)
    tracker.active.belief[...] = run.snapshot["belief"]
    updates = {
        int(event["number"]): event for event in run.events if event.get("event") == "update" and "number" in event
    }
    return _compare(run.rows, decoder, tracker, updates)


def _apply(decoder: WireDecoder, tracker: Tracker, event: Mapping[str, Any]) -> None:
    """Apply a change of zeros and belief as the servo did."""
    belief = np.zeros(1, PLANT_PARAMETERS)
    for name in PLANT_PARAMETERS.names or ():
        belief[name] = float(event["belief"][name])
    shifts = decoder.set_zeros(float(event["macro_zero_counts"]), float(event["end_zero_counts"]))
    tracker.measurement["macro_position_m"] += shifts[0]
    tracker.measurement["end_position_m"] += shifts[1]
    tracker.measurement["macro_earlier_m"] += shifts[0]
    tracker.measurement["end_earlier_m"] += shifts[1]
    tracker.update(belief, *shifts)


def _inbox_of(row: np.void, inbox: Inbox) -> None:
    """Fill an inbox with a row's raw bytes."""
    inbox.clear()
    inbox.t_ns = int(row["t_ns"])
    inbox.first_arrival_t_ns = int(row["first_arrival_t_ns"])
    inbox.first_bytes_count = int(row["first_bytes_count"])
    inbox.sensor_arrival_t_ns = int(row["sensor_arrival_t_ns"])
    inbox.sensor_bytes = row["sensor_bytes"][: int(row["sensor_bytes_count"])].tobytes()
    for name in Inbox.FRAMES:
        count = int(row[f"{name}_count"])
        if count >= 0:
            setattr(inbox, name, row[name][:count].tobytes())


def _compare(rows: np.ndarray, decoder: WireDecoder, tracker: Tracker, updates: Mapping[int, Any]) -> Comparison:
    inbox = Inbox()
    m = tracker.measurement
    seen = fields(m)
    phase_before, update_before, ticks, differing = int(Phase.IDLE), 0, 0, 0
    first = ""
    worst_n = 0.0
    for index in range(rows.size):
        row = rows[index]
        _inbox_of(row, inbox)
        inbox.sync_t_ns = int(rows[index - 1]["sync_end_t_ns"]) if index else 0
        seen.load()  # what the update below and the loop changed behind the decoder
        decoder.decode(inbox, seen)
        seen.store()
        number = int(row["update_number"])
        if number != update_before:
            if number not in updates:
                raise RecordError(f"row {index}: update {number} has no event; events.jsonl is incomplete")
            _apply(decoder, tracker, updates[number])
            update_before = number
        for name in _FROM_OUTSIDE:
            m[name][0] = row[name]
        phase = int(row["run_phase"])
        if phase == int(Phase.IDLE) and phase_before == int(Phase.STOPPED):
            m["emergency"][0] = 0  # acknowledged
        if phase in _TICKING and phase_before not in _TICKING:
            tracker.begin(int(row["law_number"]))
        if phase == int(Phase.GUIDED_STOP) and phase_before != phase:
            tracker.guide()
        wrong = [name for name in MEASUREMENT.names or () if not _same(m[name][0], row[name])]
        if phase in _TICKING:
            ticks += 1
            law = int(row["law_number"])
            if law != tracker.law_number:
                tracker.switch(law)
            for name in SETPOINT.names or ():
                tracker.setpoint[name][0] = row[f"setpoint_{name}"]
            tracker.active.step()
            command = tracker.active.command
            wrong += [name for name in COMMAND.names or () if not _same(command[name][0], row[name])]
            for name in ("macro_force_asked_n", "micro_force_asked_n"):
                worst_n = max(worst_n, abs(float(command[name][0]) - float(row[name])))
        if wrong:
            differing += 1
            if not first:
                first = f"row {index}, phase {Phase(phase).name}: {', '.join(wrong)}"
        phase_before = phase
    return Comparison(rows.size, ticks, differing, first, worst_n)


def _same(a: Any, b: Any) -> bool:
    """Equal bit for bit; nan equals nan."""
    return a == b or (a != a and b != b)
