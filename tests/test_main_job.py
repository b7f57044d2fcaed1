"""The deterministic rows of `bench main_job` in short form: the bars are the bench's own."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from bench import main_job, replaying, variants
from bench.__main__ import main, table
from bench.figure import Bar, Figure, absent, judged
from bench.following import follow, holding, reference_trajectories, rms
from sim_backend.machine import load_machine
from stagectl.profile import load_profile

TICK_S = 60e-6


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """DSMC on sine and trapezoid over the wire, one seed."""
    profile, machine = load_profile(main_job.STAGE), load_machine(main_job.STAGE)
    planned = reference_trajectories(profile)
    found = follow(profile, machine, 11, ("dsmc",), planned, tmp_path_factory.mktemp("follow") / "run", TICK_S)
    return {one.trajectory: one for one in found}


def below(bar: Bar, value: float) -> bool:
    """Tell whether the bench would say that it holds."""
    return judged(bar, value).holds is True


def test_dsmc_keeps_the_end_within_its_bars(followed):
    """Lower bounds: 5 nm of noise must leave a trace, and measured is never quieter than true."""
    for one in followed.values():
        assert one.contact_share == 0.0
        assert 1e9 * one.true_peak_m > 5.0
        assert below(main_job.PEAK, 1e9 * one.true_peak_m)
        assert one.measured_peak_m > 0.5 * one.true_peak_m
    hold = followed["trapezoid"]
    assert 1e9 * hold.true_hold_rms_m > 2.0
    assert below(main_job.HOLD, 1e9 * hold.true_hold_rms_m)
    assert hold.measured_hold_rms_m > hold.true_hold_rms_m


def test_the_whole_of_both_trajectories_is_scored(followed):
    profile = load_profile(main_job.STAGE)
    for planned in reference_trajectories(profile):
        assert followed[planned.name].cycles >= planned.setpoints.size


def test_sample_to_sync_is_short_and_steady(followed):
    """Two RPDOs and SYNC take 0.22 ms of a classic bus, and the line 0.15 ms: it can't be shorter either."""
    for one in followed.values():
        assert 1e3 * one.sample_to_sync_p50_s > 0.37
        assert below(main_job.LATENCY, 1e3 * one.sample_to_sync_p50_s)
        assert below(main_job.JITTER, 1e6 * one.sync_jitter_rms_s)


@pytest.mark.parametrize("exact", [True, False])
def test_identification_keeps_its_bars(exact, tmp_path):
    found = main_job.identify(7, 1.0, exact, TICK_S, tmp_path)
    if exact:
        assert below(main_job.JOINT_EXACT, 100.0 * max(found.stiffness_share, found.width_share))
        assert below(main_job.EDGE_EXACT, 1e6 * found.edge_m)
        assert 1e6 * found.edge_m < 0.2  # 0.4 where the offset of the spring between the stages is not looked for
    else:
        assert below(main_job.WIDTH_WRONG, 100.0 * found.width_share)
        assert below(main_job.STIFFNESS_WRONG, 100.0 * found.stiffness_share)
        assert found.stiffness_share > 0.003  # the wrong masses and force constants must show


def test_sample_instants_of_lines_keep_their_bar():
    errors_s = [main_job.instants("line", seed, 8.0) for seed in (21, 22)]
    for one in errors_s:
        assert one.size > 5900
        assert rms(one) > 1e-9
        assert below(main_job.INSTANT_LINE, 1e6 * rms(one))


def test_sample_instants_of_usb_frames_are_worse_but_bounded():
    assert 1e-6 < rms(main_job.instants("usb-125us", 21, 8.0)) < 125e-6


def test_a_hold_begins_when_the_reference_has_stood_for_a_while():
    speed = np.zeros(3000)
    speed[1000:1500] = 0.1
    hold = holding(speed, 1000.0)
    assert not hold[:1799].any()
    assert hold[1799:].all()
    assert not holding(np.zeros(10), 1000.0).any()


def test_variants_change_what_they_say_and_nothing_else():
    profile, machine = load_profile(main_job.STAGE), load_machine(main_job.STAGE)
    exact = variants.believed(machine, profile)
    assert (exact.macro.mass_kg, exact.macro.force_constant_n_per_a) == (70.0, 100.0)
    assert (exact.micro.mass_kg, exact.micro.force_constant_n_per_a) == (40.0, 30.0)
    assert exact.backlash == machine.backlash
    assert machine.macro.mass_kg == 70.7
    assert variants.with_noise(machine, 1e-7).interferometer.noise_m == 1e-7


def test_a_bar_is_never_kept_by_nan():
    assert judged(Bar("x", "nm", 1.0), math.nan).holds is False
    assert judged(Bar("x", "1", 1.0, at_least=True), math.nan).holds is False
    assert judged(Bar("x", "nm", 1.0), 1.0).holds is True
    assert judged(Bar("x", "1", 1.0, at_least=True), 0.99).holds is False
    assert judged(Bar("x", "nm"), 1e9).holds is None
    assert judged(Bar("x", "nm", 1.0), math.nan).as_json()["value"] is None


def test_the_table_names_what_is_missed_and_what_is_absent():
    figures = [
        judged(Bar("short", "nm", 1.0), 2.0, [1, 2, 3], "why"),
        absent(Bar("long", "us", 5.0), "no tool"),
    ]
    lines = table(figures).splitlines()
    assert lines[2].split("|")[1:7] == [" short  ", " 2 nm  ", " <= 1 nm ", " MISSED  ", " 1-3   ", " why     "]
    assert "no tool" in lines[3]


@pytest.mark.parametrize(("holds", "code"), [(True, 0), (None, 0), (False, 1)])
def test_the_exit_code_says_whether_a_bar_was_missed(holds, code, monkeypatch, tmp_path, capsys):
    figure = Figure("a figure", 1.0, "nm", "<= 2 nm", holds, [1])
    monkeypatch.setattr(main_job, "figures", lambda full, say: iter([figure]))
    page = tmp_path / "docs" / "figures.md"
    assert main(["main_job", "--json", "--out", str(tmp_path / "out"), "--markdown", str(page)]) == code
    line = '{"figure": "a figure", "value": 1.0, "unit": "nm", "bar": "<= 2 nm", '
    assert capsys.readouterr().out.startswith(line)
    assert (tmp_path / "out").read_text().startswith(line)
    assert "| a figure | 1 nm" in page.read_text()
    assert "Load average" in page.read_text()


def test_make_bench_overwrites_only_what_it_wrote(tmp_path, monkeypatch):
    """The result of a full run takes a day, and is committed."""
    root = Path(__file__).resolve().parents[1]
    target = re.findall(r"-m bench (.*)", (root / "Makefile").read_text())
    assert len(target) == 4
    for command in target:
        page = root / re.findall(r"--markdown (\S+)", command)[0]
        assert "--full" not in command
        assert not page.exists() or "\nWritten by `make bench` on " in page.read_text(), page
    monkeypatch.setattr(main_job, "figures", lambda full, say: iter(()))
    main(["main_job", "--full", "--markdown", str(tmp_path / "full.md")])
    assert "\nWritten by `python -m bench main_job --full` on " in (tmp_path / "full.md").read_text()


def test_a_replay_without_motion_does_not_hold():
    found = [replaying.Replayed("oled-printer", {"dsmc": 0, "pid": 5}, 0, "")]
    assert main_job._replay_figure(found).holds is False
    found = [replaying.Replayed("oled-printer", {"dsmc": 5, "pid": 5}, 1, "row 3")]
    assert main_job._replay_figure(found).holds is False
    found = [replaying.Replayed("oled-printer", {"dsmc": 5, "pid": 5}, 0, "")]
    assert main_job._replay_figure(found).holds is True
