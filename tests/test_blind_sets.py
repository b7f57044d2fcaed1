"""Blind sets as the gap workflow gets them: read rightly, held out by the rule, marked, and robust to a failure."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import blind_sets
from bench.blind_sets import Job, Searched, held_out, line, load_set, marked, summary_lines
from bench.seeds import seeds_of
from stagectl.gap import balance
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.innovations import Noise
from tests.blind import draw, generate
from tests.blind.machine import B

_SECONDS = 4.0


def written(tmp_path, seed, **changes):
    """A set of development seed `seed` with nothing missing, as handed over, and its case."""
    case = draw.draw(seed, "null", _SECONDS)
    for name, value in changes.items():
        setattr(case, name, value)
    generate.write(case, tmp_path)
    return load_set(tmp_path), case


@pytest.fixture(scope="module")
def macro_micro(tmp_path_factory):
    for seed in range(1, 60):
        case = draw.draw(seed, "null", _SECONDS)
        full = case.base[B["micro_reaction"]] * case.base[B["contact_damping_n_s_per_m"]] > 0.0
        if not case.single and full and case.runs[-1].recipe == "two_sided_contact":
            folder = tmp_path_factory.mktemp("set")
            generate.write(case, folder)
            return load_set(folder), case, folder
    raise AssertionError("no such seed")


@pytest.fixture(scope="module")
def single_axis():
    return next(s for s in range(1, 60) if draw.draw(s, "null", _SECONDS).single)


def left(blind, number, believed=None):
    """Mean square of each axis's innovations under what is believed, in units of sensor noise and coloured force."""
    recording = balance.recording_of(blind.logs[number], believed or blind.believed)
    noise = {
        "macro": Noise(blind.believed.macro.noise_m, 0.05, 2 * np.pi * 2, 0.005),
        "end": Noise(blind.believed.micro.noise_m if blind.believed.micro else 1.0, 0.05, 2 * np.pi * 2, 0.005),
    }
    balance.set_noise(recording, {axis: noise[axis] for axis in recording.axes})
    known = known_forces(recording)
    forces = {"macro": known.macro_n, "end": known.end_n}
    return [
        float(np.mean(balance.whitened(recording, axis, forces[axis], recording.position_m(axis)) ** 2))
        for axis in recording.axes
    ]


def test_sides_signs_delays_and_payload_are_read_as_the_plant_has_them(macro_micro, tmp_path):
    """A belief that is right leaves noise, and every wrong turn of it more; the run touches both stops."""
    _, case, _ = macro_micro
    runs = [replace(run, payload_kg=0.0) for run in case.runs[:-1]] + [replace(case.runs[-1], payload_kg=6.0)]
    case = replace(case, runs=runs, belief={name: float(case.base[B[name]]) for name in case.belief})
    case.runs = draw.simulate(case)
    generate.write(case, tmp_path)
    blind = load_set(tmp_path)
    last, believed = len(blind.logs) - 1, blind.believed
    joint, log = believed.joint, blind.logs[-1]
    good = np.array(left(blind, last))
    assert np.all(good < 1.1)
    sides = replace(
        joint,
        left_m=joint.right_m,
        right_m=joint.left_m,
        left_stiffness_n_per_m=joint.right_stiffness_n_per_m,
        right_stiffness_n_per_m=joint.left_stiffness_n_per_m,
    )
    assert np.all(left(blind, last, replace(believed, joint=sides)) > 3.0 * good)
    stiffer = replace(sides, left_m=joint.left_m, right_m=joint.right_m)
    assert left(blind, last, replace(believed, joint=stiffer))[1] > 1.05 * good[1]
    unreactive = tuple(row for row in believed.effects if row["name"] != "micro_reaction")
    assert left(blind, last, replace(believed, effects=unreactive))[0] > 3.0 * good[0]
    early = replace(believed, macro=replace(believed.macro, latch_s=0.0), micro=replace(believed.micro, latch_s=0.0))
    assert np.all(left(blind, last, early) > 1.02 * good)  # slow motion tells little of a delay
    empty = replace(blind, logs=(*blind.logs[:-1], replace(log, end_payload_kg=0.0)))
    assert left(empty, last)[1] > 1.2 * good[1]


def test_what_is_stated_is_what_is_believed(macro_micro):
    blind, case, _ = macro_micro
    believed, belief, sds = blind.believed, case.belief, case.uncertainty
    assert believed.macro.mass_kg == pytest.approx(belief["macro_mass_kg"])
    assert believed.micro.force_constant_n_per_a == pytest.approx(belief["micro_force_constant_n_per_a"])
    assert believed.joint.left_m == pytest.approx(belief["right_edge_m"])
    assert believed.joint.width_sd_m == pytest.approx(sds["left_edge_m"])
    assert believed.joint.left_stiffness_sd_ratio == pytest.approx(
        sds["right_contact_stiffness_n_per_m"] / belief["right_contact_stiffness_n_per_m"]
    )
    assert believed.micro.latch_sd_s == pytest.approx(sds["micro_command_delay_s"])
    assert believed.micro.noise_m == pytest.approx(case.sensor_noise_m[1])
    assert all(ratio > 0.0 for ratio in believed.effect_sd_ratios.values())
    for log, run in zip(blind.logs, case.runs, strict=True):
        assert (log.session, log.end_payload_kg, log.macro_payload_kg) == (str(run.homing), run.payload_kg, 0.0)
        assert log.macro_current_a.shape == log.macro_position_m.shape == (round(_SECONDS * 1000),)
        assert log.start_s == run.start_s


def test_commands_in_amperes_are_the_same_forces(macro_micro, tmp_path):
    blind, case, _ = macro_micro
    other = tmp_path / "amperes"
    generate.write(replace(case, command_in_amperes=not case.command_in_amperes), other)
    for one, same in zip(blind.logs, load_set(other).logs, strict=True):
        assert same.macro_command_n == pytest.approx(one.macro_command_n, abs=1e-5)
        assert same.micro_command_n == pytest.approx(one.micro_command_n, abs=1e-5)
        assert np.ptp(one.macro_command_n) > 0.1


def test_what_a_loop_swings_at_its_limits_is_left_out(macro_micro, tmp_path):
    """A clock of 28 ppm made a loop unstable: a search ended with the error of a refused recording (1006014)."""
    blind, case, _ = macro_micro

    def swinging_from(run, first):
        samples = run.samples.copy()
        samples[first:, 3] = 180.0 * np.sign(np.sin(2.0 * np.pi * 100e-3 * np.arange(len(samples) - first) + 0.1))
        return replace(run, samples=samples)

    runs = [swinging_from(case.runs[0], 200), *case.runs[1:-1], swinging_from(case.runs[-1], 3000)]
    generate.write(replace(case, runs=runs), tmp_path)
    cut = load_set(tmp_path)
    assert [log.name for log in cut.logs] == [log.name for log in blind.logs[1:]]
    assert cut.gains == blind.gains[1:]
    assert cut.logs[-1].samples_count == cut.relative_reference_m[-1].size == 3000
    assert cut.logs[-1].start_s == blind.logs[-1].start_s
    assert np.array_equal(cut.relative_reference_m[-1], blind.relative_reference_m[-1][:3000])


def test_one_axis_has_no_micro_and_its_damping_is_an_effect(single_axis, tmp_path):
    blind, case = written(tmp_path, single_axis)
    assert blind.believed.micro is None
    assert blind.believed.joint is None
    (row,) = blind.believed.effects
    assert (row["name"], row["damping_n_s_per_m"]) == (
        "viscous_friction",
        pytest.approx(case.belief["macro_damping_n_s_per_m"]),
    )
    for log, run in zip(blind.logs, case.runs, strict=True):
        assert log.micro_command_n is None
        assert log.end_position_m is None
        assert (log.macro_payload_kg, log.end_payload_kg) == (run.payload_kg, 0.0)
    assert held_out(blind) == () or len(blind.logs) >= 4


def test_held_out_is_the_run_that_differs_most_and_never_the_only_one_at_the_stops_or_so_fast(macro_micro):
    blind, _, _ = macro_micro
    log, gains = blind.logs[0], blind.gains[0]
    free, stops = np.zeros(10), np.linspace(-1e-3, 1e-3, 10)

    def made(sessions, payloads, touching, fast=()):
        logs = tuple(
            replace(log, name=f"run_{k}", session=s, end_payload_kg=p, reference_m=log.reference_m * (1 + (k in fast)))
            for k, (s, p) in enumerate(zip(sessions, payloads, strict=True))
        )
        paths = tuple(stops if k in touching else free for k in range(len(logs)))
        return replace(blind, logs=logs, gains=(gains,) * len(logs), relative_reference_m=paths)

    assert held_out(made("000", (0, 0, 0), ())) == ()
    assert held_out(made("0000", (0, 0, 0, 0), ())) == (3,)
    assert held_out(made("0000", (0, 0, 0, 0), (3,))) == (2,)
    assert held_out(made("0000", (0, 0, 0, 0), (1, 3))) == (3,)
    assert held_out(made("00100", (0, 0, 0, 0, 0), ())) == (2,)
    assert held_out(made("01000", (0, 3, 0, 4, 0), (4,))) == (1,)
    assert held_out(made("0000", (0, 0, 0, 0), (), (3,))) == (2,)
    assert held_out(made("0000", (0, 0, 0, 0), (2,), (3,))) == (1,)
    assert held_out(made("0001", (0, 0, 0, 0), (), (1, 3))) == (3,)


# ---- marking ---------------------------------------------------------------------------------------------------------


def member(name="coulomb_friction", acts_on="macro_force", above=True, inseparable=()):
    return {
        "name": name, "acts_on": acts_on, "both_axes": False, "outside": False, "amplitude": "level_n",
        "parameters": {"level_n": 2.0}, "d_prime": 50.0, "limit": 0.1, "above_twice_limit": above,
        "above_ten_times_limit": above, "inseparable": [list(key) for key in inseparable],
    }  # fmt: skip


def said(*effects, verdict=None, parameters=()):
    values = {"parameters": {"level_n": 2.1}, "interval": {"level_n": [1.9, 2.3]}}
    rows = [
        {"name": name, "acts_on": "macro_force", "alias_set": [list(alias) for alias in aliases], **values}
        for name, *aliases in effects
    ]
    wrong = [{"name": name, "acts_on": place, "alias_set": []} for name, place in parameters]
    return {"verdict": verdict or ("found" if rows else "nothing"), "effects": rows, "parameter_errors": wrong}


def searched(found, *members, kind="single", parameters=(), error=""):
    truth = {"seed": 7, "kind": kind, "effects": list(members), "parameter_errors": list(parameters)}
    return Searched(7, truth, found, 1, (100.0, 3.0), 10.0, 1.0, error)


@pytest.mark.parametrize(
    ("one", "label", "right"),
    [
        (searched(said(("coulomb_friction",)), member()), "right", True),
        (searched(said(), member()), "missed", False),
        (searched(said(verdict="unknown"), member()), "unknown", False),
        (searched(said(("offset",)), member()), "confused", False),
        (searched(said(("coulomb_friction",), ("offset",)), member()), "extra name", False),
        (searched(said(("coulomb_friction", ("offset", "macro_force"))), member()), "set too wide", False),
        (
            searched(
                said(("coulomb_friction", ("offset", "macro_force"))),
                member(inseparable=[("offset", "macro_force")]),
            ),
            "right",
            True,
        ),
        (searched(said(("coulomb_friction",)), member(), member("offset"), kind="multi"), "partly", False),
        (searched(said(), kind="null"), "right", True),
        (searched(said(("offset",)), kind="null"), "false", False),
        (searched(said(verdict="unknown"), member("bumps_in_the_guide"), kind="outside"), "right", True),
        (searched(said(("offset",)), member("bumps_in_the_guide"), kind="outside"), "misnamed", False),
        (searched(said(("offset",)), member(above=False)), "false", False),
        (searched(said(), member(above=False)), "right", True),
        (
            searched(
                said(parameters=[("mass_error", "macro_force")]),
                kind="parameter",
                parameters=[member("mass_error")],
            ),
            "right",
            True,
        ),
        (searched(said(), kind="parameter", parameters=[member("mass_error")]), "missed", False),
        (searched(said(), kind="null", error="ValueError: x"), "error", False),
    ],
)
def test_labels(one, label, right):
    result = marked(one)
    assert (result.label, result.right) == (label, right)
    assert line(result).strip().startswith("7 ")


def test_an_error_is_wrong_and_the_others_go_on(tmp_path):
    """The folder of sets can't be made: every set says so, none is right, and the summary still comes."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    jobs = [Job(seed, "null", blocked) for seed in (1, 2)]
    done = [marked(one) for one in blind_sets.searched(jobs, 1)]
    assert [one.label for one in done] == ["error", "error"]
    assert not any(one.right for one in done)
    assert "2 sets ended in an error: 1, 2" in "\n".join(summary_lines(done))


class KillsItsReader:
    def __reduce__(self):
        return os._exit, (1,)


def test_a_worker_that_dies_takes_its_own_set_with_it_only(tmp_path):
    """The others end in an error of their own here, which is quick; the death of a worker is not theirs."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    deadly = Job(1, "null", blocked, options=(("without", KillsItsReader()),))
    jobs = [deadly, *(Job(seed, "null", blocked) for seed in (2, 3, 4))]
    done = {one.seed: one.error for one in blind_sets.searched(jobs, 2)}
    assert {seed for seed, error in done.items() if "the worker died" in error} == {1}
    assert all("NotADirectoryError" in done[seed] for seed in (2, 3, 4))


def test_summary_counts_an_error_against_its_bar():
    rows = summary_lines(
        [marked(searched(said(), kind="null")), marked(searched(said(), kind="null", error="ValueError: x"))]
    )
    assert next(row for row in rows if row.startswith("null")).split()[1] == "1/2"


def test_seeds():
    assert seeds_of("100-102,7") == [100, 101, 102, 7]
    with pytest.raises(SystemExit):
        blind_sets.main(["--seeds", "1000000"])


def test_truth_is_kept_apart_and_the_folder_belongs_to_this_generator():
    folder = blind_sets.sets_folder()
    assert folder.name.startswith("stagectl-blind-")
    assert isinstance(folder, Path)
