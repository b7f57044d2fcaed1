"""`python -m bench service`: what it makes of its runs, its journal, and its mutants."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import service, service_batch, service_processes
from bench.journal import Journal
from bench.mutation import mutants, trial, uncompiled
from bench.service_mutants import MODULES, equivalent
from tests.faults import real
from tests.faults.judge import BACK, LOST, TRAVEL

ROOT = Path(__file__).resolve().parents[2]
SOURCE = '''
LIMIT = 3


def step(a, b):
    """Say which is more."""
    if a < b and not a == LIMIT:
        return a + b
    return max(a, b)
'''


def entry(kind: str, *violations: tuple[str, str], lost: int = 0, skipped: str = "") -> dict:
    return {
        "kind": kind,
        "phase": "at rest",
        "fault": "EMERGENCY",
        "line": f"{kind}: python -m bench service --seed 1",
        "skipped": skipped,
        "took_s": 1.0,
        "violations": [list(one) for one in violations],
        "begun_cycles": 1.0,
        "cycles_lost": lost,
        "drift_m": 0.0,
    }


def test_one_bad_run_is_a_missed_bar_and_says_how_to_see_it_again():
    entries = [entry("EMCY"), entry("EMCY", (TRAVEL, "5 mm"), (BACK, "no")), entry("disk full", skipped="no root")]
    found = {figure.figure: figure for figure in service_batch.of_entries(entries, [0, 1, 2])}
    assert found[f"batch: {TRAVEL}"].holds is False
    assert "python -m bench service --seed 1" in found[f"batch: {TRAVEL}"].reason
    assert found[f"batch: {LOST}"].holds is True
    assert found["batch: runs"].value == 2
    assert found["batch: runs"].reason == "1 skipped: no root"
    assert found["batch: runs with EMCY"].value == 2
    assert found[service_batch.RECOVERED.figure].value == pytest.approx(50.0)
    lost = {figure.figure: figure for figure in service_batch.of_entries([entry("EMCY", (LOST, "3"), lost=3)], [0])}
    assert (lost[f"batch: {LOST}"].value, lost[f"batch: {LOST}"].holds) == (3.0, False)


def test_an_interrupted_campaign_goes_on_where_its_journal_ends(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    Journal("test").keep(4, {"line": "four"})
    (path,) = (tmp_path / "stagectl-bench").glob("test-*.jsonl")
    path.write_text(path.read_text() + '{"seed": 5, "li')  # killed in the middle of a line
    Journal("test").keep(6, {"line": "six"})
    assert Journal("test").entries == {4: {"line": "four"}, 6: {"line": "six"}}
    assert Journal(None).entries == {}


def test_the_bound_of_a_run_with_real_processes():
    """t = 0.1 + 0.001 + 0.01 s at 0.12 m/s, ramp 5 m/s^2: 13.32 + 1.44 mm."""
    moving = {"macro_velocity_m_per_s": -0.12, "macro_position_m": 0.05}
    assert real._bound_m(real.KINDS["servo killed"], moving, 0.01) == pytest.approx(14.76e-3, abs=0.01e-3)
    driven = moving | {"macro_position_m": 0.062}  # magnets of 2 N on 12 kg, and the drive keeps what balanced them
    assert real._bound_m(real.KINDS["servo killed"], driven, 0.01) == pytest.approx(16.05e-3, abs=0.01e-3)
    assert real._bound_m(real.KINDS["EMCY"], driven, 0.107) == pytest.approx(14.76e-3, abs=0.01e-3)
    coasts = real._bound_m(real.KINDS["drive reboot"], moving, 0.01)
    assert coasts == pytest.approx(0.05 + 0.17 + 0.008)


def test_the_seeded_part_has_every_process_killed_and_stopped():
    kinds = {list(real.KINDS)[seed % len(real.KINDS)] for seed in service_processes.SEEDS}
    assert len(kinds) == len(service_processes.SEEDS) >= 10
    struck = {f"{name} {how}" for name in ("servo", "supervisor") for how in ("killed", "stopped")}
    assert struck | {"disk full", "two operators", "hostile API (schemathesis)", "client vanishes in mid jog"} <= kinds


def test_parts_are_named():
    assert set(service.PARTS) == {"batch", "processes", "losses", "pages", "soak", "mutants"}
    with pytest.raises(SystemExit, match="choose from mutants, batch, "):
        list(service.figures(full=False, say=lambda text: None, part="nothing"))


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


@pytest.mark.parametrize("module", MODULES)
def test_every_equivalent_mutant_exists_and_has_a_reason(module):
    source = (ROOT / (module.replace(".", "/") + ".py")).read_text()
    keys = {mutant.key for mutant in mutants(source)}
    for key, reason in equivalent().get(module, {}).items():
        assert key in keys
        assert len(reason) > 20
