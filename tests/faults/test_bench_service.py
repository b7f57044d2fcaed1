"""`python -m bench service`: what it makes of its runs, its journal, and its mutants."""

import ast
import subprocess
import sys
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from bench import service, service_batch, service_mutants, service_processes
from bench.__main__ import main
from bench.figure import judged
from bench.journal import Journal, beside_figures
from bench.mutation import mutants, put, trial, uncompiled
from bench.service_mutants import MODULES, Scope, equivalent
from bench.service_processes import COUNT, COUNT_FULL, FULL_LOSS_SEEDS, LOSS_SEEDS
from bench.sources import APART, service_hash, service_sources
from stagectl.errors import LinkError
from stagectl.service import lease, messages
from stagectl.service.desk import Desk
from stagectl.service.service_log import ServiceLog
from tests.faults import losses, real, soak
from tests.faults.judge import BACK, LOST, TRAVEL, _bound_m
from tests.faults.mechanics import mechanics_of
from tests.faults.witness import ENABLED

MOTIONS = ("jogging", "moving", "homing", "identifying")
ROOT = Path(__file__).resolve().parents[2]
SOURCE = '''
LIMIT = 3


def step(a, b):
    """Say which is more."""
    print(a)
    if a < b and not a == LIMIT:
        return a + b
    return max(a, b)
'''


def entry(kind: str, *violations: tuple[str, str], lost: int = 0, skipped: str = "") -> dict:
    return {
        "kind": kind,
        "phase": "at rest",
        "fault": "EMERGENCY",
        "line": f"{kind}: python -m bench service --seeds 1",
        "skipped": skipped,
        "took_s": 1.0,
        "violations": [list(one) for one in violations],
        "begun_cycles": 1.0,
        "cycles_lost": lost,
        "cycles_owed": 900,
        "drift_m": 0.0,
    }


def test_one_bad_run_is_a_missed_bar_and_says_how_to_see_it_again():
    entries = [entry("EMCY"), entry("EMCY", (TRAVEL, "5 mm"), (BACK, "no")), entry("disk full", skipped="no root")]
    found = {figure.figure: figure for figure in service_batch.of_entries(entries, [0, 1, 2])}
    assert found[f"batch: {TRAVEL}"].holds is False
    assert "python -m bench service --seeds 1" in found[f"batch: {TRAVEL}"].reason
    assert found[f"batch: {LOST}"].holds is True
    assert found["batch: runs"].value == 2
    assert found["batch: runs"].reason == "1 skipped: no root"
    assert found["batch: runs with EMCY"].value == 2
    assert found[service_batch.RECOVERED.figure].value == pytest.approx(50.0)
    lost = {figure.figure: figure for figure in service_batch.of_entries([entry("EMCY", (LOST, "3"), lost=3)], [0])}
    assert (lost[f"batch: {LOST}"].value, lost[f"batch: {LOST}"].holds) == (3.0, False)


def test_what_no_run_measured_does_not_hold():
    """One run in which nothing was noticed and no drive had power, and none at all."""
    unseen = {**entry("EMCY"), "begun_cycles": None, "cycles_owed": 0}
    found = {figure.figure: figure for figure in service_batch.of_entries([unseen], [0])}
    assert found[service_batch.BEGUN.figure].holds is False
    assert found[f"batch: {LOST}"].holds is False
    assert found[f"batch: {TRAVEL}"].holds is True
    two = {figure.figure: figure for figure in service_batch.of_entries([unseen, entry("EMCY")], [0, 1])}
    assert (two[service_batch.BEGUN.figure].value, two[service_batch.BEGUN.figure].holds) == (1.0, True)
    assert two[service_batch.BEGUN.figure].reason == "measured in 1 of 2 runs"
    assert (two[f"batch: {LOST}"].holds, two[f"batch: {LOST}"].reason) == (True, "of 900 cycles in motion")
    skipped = list(service_batch.of_entries([entry("disk full", skipped="no root")], [0], service_batch.COUNT))
    assert {figure.holds for figure in skipped} == {False, None}
    assert sum(figure.holds is False for figure in skipped) == len(service_batch.MISSED) + 3


def test_a_run_with_real_processes_that_was_skipped_measured_nothing(monkeypatch):
    skipped = real.RealResult(0, real.drawn(0), "", (), None, 1.0, "mounting a small disk needs root")
    monkeypatch.setattr(real, "run", lambda seed, folder: skipped)
    found = list(service_processes.figures(full=False, say=lambda text: None, seeds=[0]))
    assert {figure.holds for figure in found[1:]} == {False}


def test_an_interrupted_campaign_goes_on_where_its_journal_ends(tmp_path):
    path = tmp_path / "journals" / "test.jsonl"
    Journal(path).keep(4, {"line": "four"})
    path.write_text(path.read_text() + '{"seed": 5, "li')  # killed in the middle of a line
    Journal(path).keep(6, {"line": "six"})
    assert Journal(path).entries == {4: {"line": "four"}, 6: {"line": "six"}}
    assert Journal(None).entries == {}


def test_a_campaigns_journal_is_of_its_sources():
    assert beside_figures("test") == ROOT / "docs" / "journals" / f"test-{service_hash()}.jsonl"


def test_what_the_journal_leaves_out_is_imported_by_no_process_of_the_service():
    parts = (
        "stagectl.service.daemon, stagectl.commands.serve, stagectl.servo_process, stagectl.client, sim_backend.process"
    )
    code = f"import sys, {parts}, tests.faults.campaign, tests.faults.real; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    folders = [folder.replace("/", ".") for folder in APART]
    assert all((ROOT / folder).is_dir() for folder in APART)
    assert [one for one in done.stdout.split() if any(f"{one}.".startswith(f"{name}.") for name in folders)] == []


def test_the_journal_is_of_all_that_its_runs_import():
    """Asked of Python itself, which follows each import."""
    parts = ", ".join(f"tests.faults.{name}" for name in ("campaign", "real", "losses", "soak"))
    code = f"import sys, {parts}; print(*(getattr(one, '__file__', None) for one in list(sys.modules.values())))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    imported = {path for one in done.stdout.split() if (path := Path(one)).is_relative_to(ROOT / "tests")}
    names = {str(path.relative_to(ROOT)) for path in imported}
    assert {"tests/service/daemon.py", "tests/small_disk.py", "tests/struck_stage.py", "tests/toml_text.py"} <= names
    assert imported == {path for path in service_sources() if path.is_relative_to(ROOT / "tests")}


def test_a_word_of_code_that_a_run_imports_is_another_journal_and_a_sentence_about_it_is_not(tmp_path, monkeypatch):
    for path in service_sources():
        copied = tmp_path / path.relative_to(ROOT)
        copied.parent.mkdir(parents=True, exist_ok=True)
        copied.write_bytes(path.read_bytes())
    assert service_hash(tmp_path) == service_hash()
    (tmp_path / "tests/faults/test_real.py").write_text("assert True\n")  # of which no run knows
    assert service_hash(tmp_path) == service_hash()
    for name in ("service/daemon.py", "small_disk.py", "struck_stage.py", "toml_text.py", "faults/judge.py"):
        before = service_hash(tmp_path)
        with (tmp_path / "tests" / name).open("a") as file:
            file.write("# one more line\n\n\ndef added():\n    pass\n")
        after = service_hash(tmp_path)
        assert after != before, name
        text = (tmp_path / "tests" / name).read_text()
        said = text.replace("# one more line", "# another").replace("added():\n", 'added():\n    """Why."""\n')
        (tmp_path / "tests" / name).write_text(said)
        assert service_hash(tmp_path) == after, name
        (tmp_path / "tests" / name).write_text(said.replace("added():\n", "added(word='x'):\n"))
        assert service_hash(tmp_path) != after, name
    before = service_hash()
    for package in ("numpy", "numba", "python-can"):
        version = metadata.version
        with monkeypatch.context() as patched:
            patched.setattr(metadata, "version", lambda one: "0.1" if one == package else version(one))  # noqa: B023
            assert service_hash() != before, package


def test_a_seed_with_real_processes_is_the_same_run_again_and_all_of_them_are_drawn():
    drawn = [real.drawn(seed) for seed in service_processes.FULL_SEEDS]
    assert [one.text for one in drawn] == [real.drawn(seed).text for seed in service_processes.FULL_SEEDS]
    assert {one.kind for one in drawn} == set(real.KINDS)
    assert {one.phase for one in drawn} == {*MOTIONS, "at rest", "arming", "stopping", "idle"}
    assert sum(one.profile == "oled-printer" for one in drawn) > 25
    assert all(one.profile == "oled-printer" for one in drawn if one.phase == "identifying")
    assert {2 in one.fault.drawn.without_power for one in drawn if one.kind == "drive reboot"} == {False, True}
    assert len({one.wait_s for one in drawn}) == len(drawn)


def test_most_clients_that_vanish_do_so_while_they_jog():
    drawn = [one for one in map(real.drawn, range(500)) if one.kind == "client vanishes"]
    jogging = [one for one in drawn if one.phase == "jogging"]
    assert len(jogging) > len(drawn) / 2
    assert {one.fault.drawn.text.partition(",")[0] for one in jogging} == {"client killed", "client stopped"}
    # Twice as far as it may go in 0.7 s: else the end of travel stops a jog that nobody stopped.
    assert all(1.4 * one.speed_m_per_s < mechanics_of(one.profile).travel_m[1] for one in jogging)


def test_the_bound_of_a_run_with_real_processes():
    """t = 0.1 + 0.001 + 0.01 s from 0.12 m/s, 5 m/s^2 of ramp: 13.32 + 1.44 mm; magnets, 2 N on 12 kg, 0.33 m/s^2."""
    t_ns = np.arange(1000) * 1_000_000
    steady, driven = np.full(1000, -0.12), -0.12 - 0.0005 * (np.arange(1000) - 500).clip(min=0)
    single = mechanics_of("single-axis")
    bound_m = partial(_bound_m, t_ns, at=500, detection_s=0.11, of=single)
    assert bound_m(steady) == pytest.approx(14.76e-3, abs=0.01e-3)
    assert bound_m(steady, open_loop=True) == pytest.approx(14.76e-3, abs=0.01e-3)
    t, a = 0.111, 4.0 / 12.12
    rolled_m = 0.12 * t + 0.5 * a * t * t + (0.12 + a * t) ** 2 / 10.0
    assert bound_m(driven, open_loop=True) == pytest.approx(rolled_m, abs=0.01e-3)
    assert bound_m(driven) > rolled_m + 1e-3  # of a plan that goes on
    eased = -0.12 - 0.004 * (np.arange(1000) - 500).clip(min=0)
    assert bound_m(eased, limp=True) > bound_m(eased) + 0.5e-3  # of a micro that its motor lets go
    assert bound_m(steady, limp=True) == bound_m(steady)


def test_the_seeded_part_has_every_process_killed_and_stopped_in_every_motion():
    drawn = [real.drawn(seed) for seed in service_processes.SEEDS]
    kinds = {one.kind for one in drawn}
    assert len(kinds) == len(drawn) >= 10
    struck = {f"{name} {how}" for name in ("servo", "supervisor") for how in ("killed", "stopped")}
    assert struck | {"disk full", "two operators", "hostile API (schemathesis)", "client vanishes"} <= kinds
    assert all(one.fault.drawn.must_stop for one in drawn if one.kind in struck)
    assert {one.phase for one in drawn if one.kind == "client vanishes"} == {"jogging"}
    assert {one.phase for one in drawn} >= set(MOTIONS)
    assert len({one.profile for one in drawn}) == 2


def test_a_kill_and_a_cut_are_drawn_from_a_seed_in_every_phase_that_is_recorded():
    every = {name: [losses.drawn(seed) for seed in seeds] for name, seeds in FULL_LOSS_SEEDS.items()}
    assert [one.text for one in every["servo"]] == [losses.drawn(seed).text for seed in FULL_LOSS_SEEDS["servo"]]
    drawn = [one for strikes in every.values() for one in strikes]
    assert {one.scene.phase for one in drawn} >= {*MOTIONS, "at rest"}
    assert {one.supervisor_looks_away for one in every["servo"]} == {True, False}
    assert all(len(strikes) >= 10 for strikes in every.values())
    assert all(len({one.scene.profile for one in strikes}) == 2 for strikes in every.values())
    few = {name: [losses.drawn(seed) for seed in seeds] for name, seeds in LOSS_SEEDS.items()}
    assert any(one.supervisor_looks_away and one.scene.phase == "jogging" for one in few["servo"])  # told by the rig
    assert any(one.scene.profile == "oled-printer" for one in few["power"])
    assert all(one.scene.phase in MOTIONS for strikes in few.values() for one in strikes)


def loss_of(folder, rows_ns, syncs_ns, until_ns=99_000_000, state=ENABLED):
    """Held against the SYNCs of 0.1 s with power, by two runs, the first of them from before."""
    for name, t_ns in {"1": np.zeros(0, np.int64), "2": rows_ns}.items():
        (folder / name).mkdir(parents=True)
        setpoints = {f"setpoint_{name}": t_ns * 0.0 for name in ("position_m", "velocity_m_per_s")}
        table = pa.table({"t_ns": t_ns, "run_phase": t_ns * 0, "stop": t_ns * 0, **setpoints})
        with pa.ipc.new_stream(str(folder / name / "samples.arrow"), table.schema) as stream:
            stream.write_table(table)
    seen = {"t_ns": np.arange(102) * 1_000_000, "states": np.full((102, 2), state), "sync_t_ns": syncs_ns}
    return losses.loss_of(folder, seen, -1, until_ns)


@pytest.mark.parametrize(
    ("gone", "silent", "lost"),
    [
        ([], [], 0),
        ([40, 41, 42], [], 3),
        (list(range(60, 80)), list(range(10, 30)), 20),  # rows without a SYNC hide none that is missing
        ([99], [], 1),  # the last one is not forgiven
        ([98, 99], [], 2),
        ([0, 1, 2], [], 3),  # nor is the head
    ],
)
def test_every_sync_is_owed_a_row_of_its_own(tmp_path, monkeypatch, gone, silent, lost):
    monkeypatch.setattr(losses, "read_run", lambda folder: None)
    ms = np.arange(100) * 1_000_000
    found = loss_of(tmp_path, np.delete(ms, gone), np.delete(ms + 400_000, silent), 100_000_000)
    assert found.cycles_lost == lost
    assert found.unreadable == ()


def test_a_rig_that_hears_a_sync_late_has_lost_none():
    """The second SYNC of two comes behind the next row, and then nothing for two cycles."""
    rows = np.array([0, 1, 3, 4]) * 1_000_000
    syncs = np.array([1_200_000, 1_400_000, 3_400_000, 4_400_000])
    assert not losses.unmatched(rows, syncs).any()
    assert losses.unmatched(np.delete(rows, 2), syncs).tolist() == [False, False, True, False]


@pytest.mark.parametrize("missing", [(), (30,), (5, 60, 61)])
def test_what_a_rig_hears_late_and_at_once_is_no_lost_cycle_and_hides_none(missing):
    """It stood still for 50 ms, and heard 50 SYNCs then."""
    rows = np.arange(200) * 1_000_000
    syncs = rows + 400_000
    syncs[10:60] = syncs[59]
    assert losses.unmatched(np.delete(rows, missing), syncs).sum() == len(missing)


def test_a_strike_that_owed_no_row_has_not_held(tmp_path, monkeypatch):
    """The stage had no power from its begin on: there is nothing that could have been lost."""
    monkeypatch.setattr(losses, "read_run", lambda folder: None)
    ms = np.arange(100) * 1_000_000
    empty = loss_of(tmp_path, ms, ms + 400_000, 100_000_000, state=-1)
    assert (empty.syncs_count, empty.cycles_lost) == (0, 0)
    whole = losses.Loss(100, 100, 0)
    for found in ([empty], [whole, empty], [empty, whole]):
        for bar in (service_processes.LOST_SERVO, service_processes.LOST_POWER):
            figure = service_processes.lost_figure(bar, found, [1], "so many")
            assert figure.holds is False
            assert "nothing measured" in figure.reason
    assert service_processes.lost_figure(service_processes.LOST_SERVO, [whole], [1], "").holds is True
    late = service_processes.lost_figure(service_processes.LOST_POWER, [losses.Loss(900, 600, 300)], [1], "", 1e-3)
    assert (late.value, late.holds) == (pytest.approx(0.3), False)


MB = 1_000_000


def soaked(supervisor_mb, servo_bytes=(270 * MB,) * 3, motions=300):
    supervisor_bytes = tuple(round(one * MB) for one in supervisor_mb)
    return soak.Soaked(servo_bytes, supervisor_bytes, motions, 1_200_000, 600, ())


def of_soak(one, duration_s=1200.0):
    return {figure.figure: figure for figure in service_processes.of_soak(one, duration_s)}


def test_a_leak_does_not_hide_behind_what_was_given_back():
    """127.9 MB at first, 125.0 then, and 3 MiB more: less than at first, by the end."""
    growth = service_processes.SUPERVISOR_GROWTH.figure
    hidden = of_soak(soaked([127.9, 125.0, *np.linspace(125.0, 125.0 + 3 * 2**20 / MB, 20)]))[growth]
    assert hidden.value == pytest.approx(3.0, abs=1e-5)
    assert hidden.holds is False
    assert "127.900 MB at first, 125.000 to 128.146 since" in hidden.reason
    steady = of_soak(soaked([127.9, 125.0, 125.2, 132.0, 125.3]))[growth]  # the faults' last seconds were written
    assert (steady.value, steady.holds) == (pytest.approx(0.3 * MB / 2**20, rel=1e-6), True)
    pages = [270 * MB + 4096 * count for count in (9, 0, 2)]
    assert of_soak(soaked([125.0], servo_bytes=pages))[service_processes.SERVO_GROWTH.figure].value == 2 * 4096


def test_a_soak_whose_stage_stood_still_does_not_hold():
    """1200 s have room for 750 motions with their pauses of 1.6 s; half of them is the least."""
    for count, holds in ((0, False), (374, False), (375, True)):
        figure = of_soak(soaked([125.0], motions=count))[service_processes.SOAK_MOTIONS]
        assert (figure.value, figure.holds, figure.bar) == (count, holds, ">= 375 motions")
    assert of_soak(soaked([125.0], motions=56), 180.0)[service_processes.SOAK_MOTIONS].holds is True


class Standing:
    """A house whose stage does as told, but for what a test takes away from it; its pauses are none."""

    def __init__(self, trouble="", sets_off=True, unheard=False, speed_m_per_s=0.0, faults=()):
        self.trouble, self.sets_off, self.unheard, self.speed_m_per_s = trouble, sets_off, unheard, speed_m_per_s
        self.faults = iter(faults)
        self.daemon = self.client = self

    def let_go(self):
        pass

    def fault(self):
        return next(self.faults, None)

    def ready(self):
        return self.trouble

    def set_off(self):
        if self.unheard:
            raise LinkError("the stage's service does not answer")
        return self.sets_off

    def metrics(self):
        pass


@pytest.fixture
def quick_soak(monkeypatch):
    """Let 100 s pass in no time."""
    now_s = [0.0]
    monkeypatch.setattr(soak.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(soak.time, "sleep", lambda duration_s: now_s.__setitem__(0, now_s[0] + duration_s))

    def work(house):
        looked, said = [], []
        count = soak.work(house, 100.0, said, lambda: looked.append(now_s[0]))
        assert len(looked) > 60
        return count, said

    return work


def test_only_a_motion_that_ran_and_came_to_rest_is_counted(quick_soak):
    """62 laps of 1.6 s; the last one has no end."""
    assert quick_soak(Standing()) == (62, [])
    count, said = quick_soak(Standing(sets_off=False))
    assert (count, set(said)) == (0, {"a jog did not set off"})
    assert quick_soak(Standing(speed_m_per_s=0.1))[0] == 0
    count, said = quick_soak(Standing(unheard=True))
    assert (count, set(said)) == (0, {"the stage's service does not answer"})
    fault = messages.Fault.model_construct(kind="EMERGENCY", values="EMCY 0x8700")
    assert quick_soak(Standing(faults=[None, None, fault])) == (61, ["EMERGENCY: EMCY 0x8700"])


def test_a_stage_that_cant_be_armed_ends_the_soak(quick_soak):
    with pytest.raises(RuntimeError, match="the stage stood still: not armed after 120 s: fault"):
        quick_soak(Standing(trouble="not armed after 120 s: fault"))


def test_a_run_that_cant_be_read_is_counted(tmp_path):
    found = loss_of(tmp_path, np.arange(100) * 1_000_000, np.arange(100) * 1_000_000 + 400_000)
    assert len(found.unreadable) == 2  # they have no manifest


def test_only_a_cycle_that_may_have_been_under_way_is_owed_no_row():
    seen = {"sync_t_ns": np.arange(100) * 1_000_000 + 400_000}
    assert losses.counted_until(seen, 99_900_000) == 99_399_999
    assert losses.counted_until(seen, 100_500_000) == 99_400_000


def test_when_the_drives_stopped_is_read_from_the_rig_s_log():
    """Killed at 500 ms, 21 ms until the drive follows no more, 24 ms of ramp from 0.12 m/s."""
    ms = np.arange(1000)
    seen = {
        "t_ns": ms * 1_000_000,
        "states": np.stack([np.where(ms < 521, ENABLED, 5), np.full(1000, -1)], axis=1),
        "macro_velocity_m_per_s": (0.12 - 5e-3 * (ms - 521).clip(min=0)).clip(min=0.0),
    }
    found = losses.stopped(seen, 500_000_000)
    assert found.begun_s == pytest.approx(0.021)
    assert found.rest_s == pytest.approx(0.024)
    seen["states"][:, 0] = ENABLED
    assert losses.stopped(seen, 500_000_000).begun_s == np.inf


def test_the_last_figure_is_how_long_all_parts_took(monkeypatch):
    monkeypatch.setattr(service, "PARTS", {"soak": lambda **_: iter(()), "batch": lambda **_: iter(())})
    ended, figure = service.figures(full=False, say=lambda text: None)
    assert (ended.value, ended.holds) == (2, True)
    assert (figure.figure, figure.bar, figure.holds) == ("all parts together", "<= 900 s", True)
    assert figure.reason == "soak 0 s, batch 0 s"
    assert len(list(service.figures(full=False, say=lambda text: None, part="soak"))) == 1


def test_a_part_that_breaks_takes_no_other_along_and_is_a_missed_bar(monkeypatch):
    def breaks(**_):
        yield judged(service_batch.COUNT, service_batch.RUNS)
        raise RuntimeError("the servo was made anew")

    monkeypatch.setattr(service, "PARTS", {"soak": breaks, "batch": lambda **_: iter([judged(COUNT, 10)])})
    first, second, ended, _ = service.figures(full=False, say=lambda text: None)
    assert (first.holds, second.holds) == (True, True)
    assert (ended.value, ended.holds) == (1, False)
    assert ended.reason == "soak: RuntimeError: the servo was made anew"


def test_too_few_runs_are_a_missed_bar():
    entries = [entry("EMCY")] * (service_batch.RUNS - 1)
    (figure, *_) = service_batch.of_entries(entries, list(range(service_batch.RUNS - 1)), service_batch.COUNT)
    assert figure.holds is False
    assert service_batch.COUNT_FULL.limit == 900
    assert (COUNT.limit, COUNT_FULL.limit) == (10, 100)


def test_cycles_lost_with_real_processes_are_a_missed_bar(monkeypatch):
    scenario = real.drawn(0)
    lost = real.RealResult(0, scenario, "LinkError", ((LOST, "7 cycles on the bus have no row"),), None, 1.0)
    monkeypatch.setattr(real, "run", lambda seed, folder: lost)
    found = {one.figure: one for one in service_processes.figures(full=False, say=lambda text: None, seeds=[0])}
    assert found[f"real processes: {LOST}"].holds is False


def test_parts_are_named():
    assert set(service.PARTS) == {"batch", "processes", "losses", "pages", "soak", "mutants"}
    assert set(service.SEEDED) < set(service.PARTS)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["service", "--part", "nothing"], "--part nothing: service has mutants, batch, "),
        (["gap", "--part", "speed"], "--part speed: gap has no parts"),
        (["paper", "--seeds", "7"], "--seeds: paper has no runs"),
        (["service", "--part", "soak", "--seeds", "7"], "--seeds with --part soak: choose from batch, processes"),
        (["service", "--seeds", "seven"], "'seven' is no seed; write 7, 100-140 or"),
        (["service", "--seeds", "9-7"], "9-7 holds no seed"),
        (["service", "--seeds", "0-999999999999"], "or more than 100000"),
        (["service", "--seeds", "nan"], "'nan' is no seed"),
    ],
)
def test_what_cannot_be_measured_is_wrong_usage(asked, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(asked)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_mutants_are_small_changes_that_differ_from_the_code_and_from_each_other():
    made = mutants(SOURCE)
    plain = ast.unparse(ast.parse(SOURCE))
    for mutant in made:
        assert ast.unparse(mutant.apply()) != plain, mutant.key
        mutant.revert()
        assert ast.unparse(mutant.tree) == plain
    keys = {mutant.key for mutant in made}
    assert len(keys) == len(made)
    assert {
        "module: in LIMIT = 3: 3 -> 4",
        "step: print(a) -> nothing",
        "step: a < b -> a <= b",
        "step: a < b and (not a == LIMIT) -> a < b or not a == LIMIT",
        "step: not a == LIMIT -> a == LIMIT",
        "step: a + b -> a - b",
        "step: max(a, b) -> min(a, b)",
        "step: return a + b -> nothing",
        "step: if a < b and (not a == LIMIT): -> if True:",
    } <= keys
    assert not [key for key in keys if "Say which" in key]


def test_uncompiled_code_sees_fields_of_a_row():
    rows = np.zeros(1, [("force_n", "f8"), ("cycle", "i8")])

    @uncompiled
    def step(row, added):
        row.force_n += added
        return row.cycle

    rows["cycle"] = 7
    assert step(rows[0], 2.5) == 7
    assert rows["force_n"][0] == 2.5


def test_a_mutant_is_alive_where_no_test_notices_it():
    """Three that the tests of the lease must see, and one that changes nothing."""
    name, tests = "stagectl.service.lease", ["tests/service/test_lease_edges.py"]
    made = {one.key: one for one in mutants((ROOT / "stagectl/service/lease.py").read_text())}
    seen = [
        made["Lease.left_s: max(self.until_s - now_s, 0.0) -> min(self.until_s - now_s, 0.0)"],
        made["module: in GRACE_S = 1.0: 1.0 -> 2.0"],
        made["take: now_s + duration_s -> now_s - duration_s"],
    ]
    nothing = replace(seen[0], replacement=seen[0].kept)
    said = []
    found = trial(name, [*seen, nothing], tests, 30.0, said.append)
    assert found.alive == (3,)
    assert found.tests_count > 20
    assert len(said) == 1
    with pytest.raises(RuntimeError, match="no test could be collected"):
        trial(name, [nothing], ["tests/service/there_is_none.py"], 30.0, said.append)


def test_the_default_of_a_field_is_mutated_too():
    """A lease that is made is not given back: what a mutant makes of that is seen by whoever has the class already."""
    name = "stagectl.service.lease"
    made = {one.key: one for one in mutants((ROOT / "stagectl/service/lease.py").read_text())}
    default = made["Lease: in released: bool = False: False -> True"]
    assert trial(name, [default], ["tests/service/test_lease_edges.py"], 30.0, lambda text: None).alive == ()
    assert lease.Lease("t", "anna", 1.0, 1.0).released is False  # here nothing was changed


@pytest.mark.parametrize("name", list(MODULES))
def test_uncompiled_the_code_passes_its_tests(name):
    """A guard with an array in its row could not be run so: from 0059 on nobody tried its mutants, and 17 lived."""
    assert trial(name, [], MODULES[name].tests, 60.0, lambda text: None).alive == ()


def test_a_property_is_mutated_in_its_place():
    (one,) = [
        one
        for one in MODULES["stagectl.service.desk"].mutants("stagectl.service.desk")
        if one.function == "Desk._busy" and one.change == "self._current is not None -> self._current is None"
    ]
    desk = Desk(ServiceLog(None))
    getter = Desk._busy.fget
    assert getter is not None
    before = getter.__code__
    try:
        put(sys.modules[Desk.__module__], one.apply(), one.function)
        with pytest.raises(AttributeError):
            desk._busy  # noqa: B018 - None has no end
    finally:
        one.revert()
        getter.__code__ = before
    assert desk._busy is False


SHOWN = {  # modules whose code speaks of a lease, but only shows it or carries it about
    "batch": "a measurement made up for a loop without a service",
    "cli": "an option's name",
    "client": "the other side: one that renews none stops the stage",
    "linear_loop": "a measurement made up for a loop without a service",
    "profile": "a key's name",
    "signals": "a stop's sentence",
    "service.access": "a header's name",
    "service.api": "routes to the desk",
    "service.daemon": "joins the desk to the sockets",
    "service.faults": "what to do about a fault",
    "service.messages": "layouts",
    "service.stage_state": "shows the desk's",
    "service.stage_world": "joins the desk to the session",
    "temperatures": "a time that is shorter than a lease",
}


def test_whatever_handles_a_lease_is_mutated():
    speak = set()
    for path in [*(ROOT / "stagectl").glob("*.py"), *(ROOT / "stagectl/service").glob("*.py")]:
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = {one.attr for one in nodes if isinstance(one, ast.Attribute)}
        names |= {one.id for one in nodes if isinstance(one, ast.Name)}
        if any("lease" in name.lower().replace("release", "") for name in names):
            speak.add(".".join(path.relative_to(ROOT).with_suffix("").parts))
    assert speak - set(MODULES) - {f"stagectl.{name}" for name in SHOWN} == set()


@pytest.mark.parametrize("module", MODULES)
def test_every_equivalent_mutant_exists_and_has_a_reason(module):
    keys = {mutant.key for mutant in MODULES[module].mutants(module)}
    for key, reason in equivalent().get(module, {}).items():
        assert key in keys
        assert len(reason) > 20


def test_a_function_that_has_another_name_now_is_missed():
    named = Scope([], {"Desk.check_order": "", "Desk.gone": ""})
    with pytest.raises(RuntimeError, match=r"no mutants of Desk\.gone; correct"):
        named.mutants("stagectl.service.desk")


def test_no_mutant_tried_is_none_killed(monkeypatch):
    monkeypatch.setattr(service_mutants, "MODULES", {})
    killed, _ = service_mutants.figures(full=True, say=lambda text: None)
    assert killed.holds is False
