"""Residual forces against ones that were put in, and the page of findings from the command line."""

import dataclasses
import json
import re

import numpy as np
import pytest

from stagectl import cli
from stagectl.gap import balance, findings_figures, findings_page, residual
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.findings_file import read_findings
from stagectl.gap.log import Log
from stagectl.table_import import import_table
from tests.gap_tables import AXIS_MAP, MASS_KG, H, axis_table, profile_file, write_csv

NOISE_M = 5e-9


def _findings(**fields) -> Findings:
    empty = Findings(
        profile="axis",
        runs=("a",),
        holdout=(),
        verdict="nothing",
        named=(),
        parameter_errors=(),
        refitted={},
        not_excited=(),
        unknown=None,
        reducible_before=(0.0, 0.0),
        reducible_after=(0.0, 0.0),
        threshold=16.0,
    )
    return dataclasses.replace(empty, **fields)


def _believed(mass_kg: float = MASS_KG) -> Believed:
    return Believed("axis", H, BelievedAxis(mass_kg, 0.4, NOISE_M, 0.0))


def _pushed(command_n: np.ndarray, hidden_n: np.ndarray, noise_m: float = NOISE_M, name: str = "a") -> Log:
    """A mass under forces that are constant within each sample, in closed form."""
    acceleration = (command_n + hidden_n) / MASS_KG
    velocity = np.concatenate([[0.0], np.cumsum(acceleration * H)])[:-1]
    position = np.concatenate([[0.0], np.cumsum(velocity * H + 0.5 * acceleration * H * H)])[:-1]
    position = position + noise_m * np.random.default_rng(1).standard_normal(position.size)
    return Log(name, H, position, command_n, np.ones(position.size, bool), "1")


def _sine(count: int, hertz: float, size: float) -> np.ndarray:
    return size * np.sin(2.0 * np.pi * hertz * np.arange(count) * H)


def test_the_residual_force_is_what_was_hidden():
    hidden = _sine(8000, 3.0, 0.7)
    log = _pushed(_sine(8000, 0.7, 12.0), hidden)
    (found,) = residual.residuals(_believed(), _findings(), [log], [])
    assert found.before_n[found.counted] == pytest.approx(hidden[found.counted], abs=0.2)
    assert np.std((found.before_n - hidden)[found.counted]) == pytest.approx(found.sensor_rms_n, rel=0.15)
    assert found.after_n == pytest.approx(found.before_n)


def test_named_effects_and_refitted_parameters_leave_noise():
    command = _sine(8000, 0.7, 12.0)
    log = _pushed(command, np.full(8000, 0.4))
    offset = Named("offset", "macro_force", {"force_n": 0.4}, {"force_n": 0.01}, 100.0, 100.0, ())
    wrong = _believed(1.1 * MASS_KG)
    findings = _findings(named=(offset,), refitted={"macro_mass_kg": -0.1}, verdict="found")
    (found,) = residual.residuals(wrong, findings, [log], [])
    # 1.1 m a - f = 0.1 f + 1.1 offset before; a mass error of -0.1 adds 0.1 of the known forces.
    assert found.before_rms_n == pytest.approx(np.hypot(1.2 / np.sqrt(2.0), 0.44), rel=0.05)
    assert found.after_rms_n == pytest.approx(np.hypot(0.04, 1.1 * found.sensor_rms_n / 1.1), rel=0.25)


def test_a_session_takes_its_own_phase():
    force = {
        "amplitude_n of session 1": 1.0,
        "amplitude_n of session 2": 2.0,
        "pitch_m": 0.02,
        "phase_rad of run a": 3.0,
    }
    named = Named("cogging", "macro_force", force, {}, 1.0, 1.0, ())
    log = _pushed(np.zeros(1000), np.zeros(1000))
    assert residual.own_parameters(named, log) == {"amplitude_n": 1.0, "pitch_m": 0.02, "phase_rad": 3.0}
    other = dataclasses.replace(log, session="2", name="b")
    assert residual.own_parameters(named, other) == {"amplitude_n": 2.0, "pitch_m": 0.02}


@pytest.mark.parametrize("noise_m", [1e-9, 3e-8])
def test_the_band_leaves_as_much_of_the_sensors_noise_as_is_said(noise_m):
    believed = dataclasses.replace(_believed(), macro=dataclasses.replace(_believed().macro, noise_m=noise_m))
    log = _pushed(_sine(20_000, 0.2, 1.0), np.zeros(20_000), noise_m)
    (found,) = residual.residuals(believed, _findings(), [log], [])
    assert found.sensor_rms_n <= 1.001 * residual.NOISE_FORCE_N
    assert np.std(found.before_n[found.counted]) == pytest.approx(found.sensor_rms_n, rel=0.12)


def test_missing_samples_are_bridged_and_not_counted():
    hidden = _sine(8000, 1.0, 0.7)
    log = _pushed(_sine(8000, 0.7, 12.0), hidden)
    position, valid = log.macro_position_m.copy(), log.valid.copy()
    missing = np.arange(500, 7500, 13)
    position[missing] += 1e-6  # 1 um in one sample is 80 N
    valid[missing] = False
    spoilt = dataclasses.replace(log, macro_position_m=position, valid=valid)
    (found,) = residual.residuals(_believed(), _findings(), [spoilt], [])
    assert not found.counted[missing].any()
    assert found.counted.mean() > 0.6
    assert found.before_n[found.counted] == pytest.approx(hidden[found.counted], abs=0.3)


def test_the_error_of_a_mean_counts_passes_and_not_samples():
    """Four passes through one bin with means 1, -1, 1, -1: sd 1.155, standard error 0.577 however many samples."""
    one = _pushed(_sine(8000, 0.5, 10.0), np.zeros(8000))
    (found,) = residual.residuals(_believed(), _findings(), [one], [])
    place = np.zeros(8000)
    moving = np.zeros(8000, bool)
    signal = np.zeros(8000)
    for number, start in enumerate((1000, 2000, 3000, 4000)):
        moving[start : start + 200] = True
        signal[start : start + 200] = 1.0 - 2.0 * (number % 2)
    flat = dataclasses.replace(
        found, before_n=signal, after_n=2.0 * signal, position_m=place, moving=moving, counted=np.ones(8000, bool)
    )
    bins = residual.binned([flat], "position_m", 1)
    assert bins.before_n[0] == pytest.approx(0.0, abs=1e-12)
    assert bins.before_error_n[0] == pytest.approx(np.sqrt(4.0 / 3.0) / 2.0, rel=1e-6)
    assert bins.after_error_n[0] == pytest.approx(2.0 * bins.before_error_n[0])


def test_the_spectrum_of_noise_is_the_line_of_the_sensor():
    log = _pushed(_sine(20_000, 0.2, 1.0), np.zeros(20_000))
    density = residual.spectrum(residual.residuals(_believed(), _findings(), [log], []))
    assert density is not None
    high = density.frequency_hz > 20.0
    assert density.before[high] == pytest.approx(density.sensor[high], rel=0.35)
    assert np.mean(density.before[high] / density.sensor[high]) == pytest.approx(1.0, abs=0.03)
    assert density.floor is None


def test_what_repeats_from_lap_to_lap_is_no_floor():
    log = _pushed(_sine(16_000, 0.75, 12.0), _sine(16_000, 1.5, 0.5))
    log = dataclasses.replace(log, reference_m=_sine(16_000, 0.75, 0.1))
    (found,) = residual.residuals(_believed(), _findings(), [log], [])
    assert found.lap_count == 1333
    assert found.before_rms_n > 0.3
    assert found.floor_rms_n == pytest.approx(found.sensor_rms_n, rel=0.2)


# ---- the page -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """The whole command on three recordings with hidden dry friction: (folder, what --json said)."""
    folder = tmp_path_factory.mktemp("gap")
    runs = []
    for seed in (1, 2, 3):
        table = write_csv(axis_table(seed, 4000, friction_n=1.0), folder / f"{seed}.csv")
        runs.append(import_table(table, AXIS_MAP, folder / f"run-{seed}"))
    arguments = ["gap", profile_file(folder), runs[0].folder, runs[1].folder, "--holdout", runs[2].folder]
    out = folder / "json"
    with open(out, "w") as stream, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", stream)
        code = cli.main([*map(str, arguments), "--out", str(folder / "out"), "--seed", "7", "--json"])
    assert code == 0
    return folder / "out", json.loads(out.read_text())


def test_the_command_writes_findings_and_page_and_says_where(searched):
    folder, answer = searched
    assert answer["page"] == str(folder / "findings.html")
    assert answer["file"] == str(folder / "findings.json")
    assert answer["seed"] == 7
    assert answer["findings"]["verdict"] == "found"
    assert "coulomb_friction on macro_force" in answer["verdict"]
    assert read_findings(folder / "findings.json").named[0].name == "coulomb_friction"


def test_the_numbers_say_what_friction_was_hidden(searched):
    _, answer = searched
    held = [row for row in answer["residual"] if row["held_out"]]
    assert len(answer["residual"]) == 3
    assert len(held) == 1
    assert held[0]["before_n"] == pytest.approx(1.0, rel=0.1)
    assert held[0]["after_n"] < 0.15
    assert 0.0 < held[0]["sensor_n"] < 0.06


def test_the_page_is_one_file_that_can_be_read_aloud(searched):
    folder, _ = searched
    text = (folder / "findings.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!#|data:)', text)
    assert "prefers-color-scheme:dark" in text
    pictures = re.findall(r"<svg[^>]*>", text)
    assert len(pictures) == 4
    for picture in pictures:
        label = re.search(r'role="img" aria-label="([^"]+)"', picture)
        assert label is not None
        assert "N rms before" in label[1]
    for words in ("How to go on", "gap apply", "gap next", "level_n", "run-3", "Seed", "Threshold", "Reducible gap"):
        assert words in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL).lower().replace("finance", "")


def test_a_page_without_motion_or_held_out_runs_is_whole(tmp_path):
    """Standing still, nothing named: no panel may fail or be made of nothing."""
    log = _pushed(1e-3 * _sine(3000, 1.0, 1.0), np.zeros(3000))
    findings = _findings(not_excited=("viscous_friction on macro_force",), remarks=("one & two",))
    residuals = residual.residuals(_believed(), findings, [log], [])
    text = findings_page.page(findings, residuals, [], profile="axis.toml", file=tmp_path / "f.json", seed=0).html()
    assert "Nothing is missing" in text
    assert "one &amp; two" in text
    assert "none apart" in text
    assert text.count("<svg") == 4


def test_the_unknown_and_wrong_parameters_are_shown(tmp_path):
    unknown = {
        "over": "position_m",
        "acts_on": "macro_force",
        "knots": [0.0, 0.1, 0.2],
        "unit": "N",
        "values": [0.1, -0.2, 0.3],
        "sds": [0.01, 0.01, 0.01],
        "gain": 50.0,
        "left": 60.0,
        "before": 90.0,
        "beside": [["coulomb_friction", "macro_force"]],
    }
    errors = (
        ParameterError("macro_mass_kg", 0.052, 0.001, 0.01, ("macro_force_constant",)),
        ParameterError("left_m", -3.2e-6, 0.1e-6, 0.3e-6),
        ParameterError("macro_latch_s", 33e-6, 5e-6, 6e-6),
    )
    findings = _findings(verdict="unknown", unknown=unknown, parameter_errors=errors, reducible_before=(9.0, 8.0))
    residuals = residual.residuals(_believed(), findings, [_pushed(_sine(3000, 1.0, 9.0), np.zeros(3000))], [])
    gap = {"command_n": 2.0, "position_m": 1e-6, "command_floor_n": float("nan"), "position_floor_m": 1e-9}
    ladder = [{"run": "a", "with": "before", **gap}]
    page = findings_page.page(findings, residuals, ladder, profile="axis.toml", file=tmp_path / "f.json", seed=0)
    text = page.html().replace("\u00a0", " ")
    for words in (
        "5.20 ± 0.20 %",
        "−3.20 ± 0.20 µm",
        "33.0 ± 9.8 µs",
        "What no effect explains",
        "Closed loop",
        "would explain a part",
    ):
        assert words in text, words
    assert "from −200 mN to 300 mN" in text


@pytest.mark.parametrize(
    ("name", "value", "sd", "said"),
    [
        ("level_n", 1.594, 0.0103, "1.594 ± 0.020 N"),
        ("amplitude_n of session a", 0.974, 0.0095, "974 ± 19 mN"),
        ("ripple_ratio", 0.03019, 0.0005, "0.03019 ± 0.00098"),
        ("pitch_m", 0.0025026, None, "2.503 mm"),
        ("level_n", 0.0, 0.1, "0 ± 196 mN"),
        ("delay_s", -1.2e-4, 3e-4, "−120 ± 588 µs"),
    ],
)
def test_values_are_said_with_the_digits_that_their_interval_leaves(name, value, sd, said):
    assert findings_page._interval(name, value, sd).replace("\u00a0", " ") == said


def test_figures_are_png_too():
    log = _pushed(_sine(3000, 1.0, 9.0), np.zeros(3000))
    residuals = residual.residuals(_believed(), _findings(), [log], [])
    for draw in (findings_figures.time_figure, findings_figures.place_figure, findings_figures.frequency_figure):
        assert draw(residuals, "png").startswith(b"\x89PNG")


def test_known_forces_are_left_as_they_were():
    """Modelled forces are sums of their own: what balance keeps for later must not change."""
    recording = balance.recording_of(_pushed(_sine(3000, 1.0, 9.0), np.zeros(3000)), _believed())
    before = recording.macro_motor_n.copy()
    residual.modelled_forces(recording, _findings(refitted={"macro_mass_kg": 0.1, "macro_force_constant": -0.2}))
    assert np.array_equal(recording.macro_motor_n, before)
