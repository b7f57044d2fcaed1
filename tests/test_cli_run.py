"""Commands that move a stage in virtual time, and a table from elsewhere."""

import re
from pathlib import Path

import pytest

from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.run_scores import segments
from tests.command import call, call_json


def test_the_value_seam_follows_and_is_recorded(capsys, tmp_path):
    arguments = ["run", "-t", "trapezoid", "--stroke-m", "0.2", "--backend", "plant", "--runs", tmp_path]
    code, answer, _ = call_json(capsys, *arguments)
    assert code == 0
    assert answer["stop"] == "FINISHED"
    (motion,) = answer["motions"]
    assert 10e-9 < motion["true"]["max_m"] < 150e-9
    assert answer["cycle"] is None  # no servo, nothing to be late
    again = call_json(capsys, *arguments)[1]
    assert again["motions"] == answer["motions"]
    code, refused, _ = call_json(capsys, "replay", answer["run"])
    assert code == 5
    assert "nothing to replay" in refused["error"]["message"]
    code, plotted, _ = call_json(capsys, "runs", "plot", answer["run"])
    assert code == 0
    assert Path(plotted["files"][0]).read_text(encoding="utf-8").count("<svg") == 2


def test_a_stop_behind_the_value_seam_is_said_with_its_numbers(capsys, tmp_path):
    source = Path(load_profile("oled-printer").source_path)
    hot = source.read_text(encoding="utf-8")
    for line, tight in (("thermal_force_n = 700.0", 30.0), ("thermal_time_constant_s = 60.0", 0.5)):
        assert hot.count(line) == 1
        hot = hot.replace(line, f"{line.partition(' = ')[0]} = {tight}")
    (tmp_path / source.name).write_text(hot)
    for eds in source.parent.glob("*.eds"):
        (tmp_path / eds.name).write_bytes(eds.read_bytes())
    arguments = ["run", "--stroke-m", "0.1", "--profile", tmp_path / source.name, "--backend", "plant"]
    code, answer, _ = call_json(capsys, *arguments, "--runs", tmp_path / "runs")
    assert (code, answer["stop"]) == (1, "THERMAL")
    assert re.search(r"macro at 30\.\d N rms, limit 30 N; let it cool", answer["text"])
    assert answer["ended_early"] == [answer["text"]]
    assert answer["text"].endswith(call_json(capsys, "runs", "show", answer["run"])[1]["text"])


def test_the_value_seam_identifies(capsys, tmp_path):
    code, answer, _ = call_json(capsys, "identify", "--backend", "plant", "--duration-s", "8", "--runs", tmp_path)
    assert code == 0
    found = answer["backlash"]
    for side in ("left", "right"):
        assert abs(found[f"{side}_edge_m"] - found[f"{side}_edge_true_m"]) < 0.5e-6
        assert found[f"{side}_stiffness_n_per_m"] == pytest.approx(found[f"{side}_stiffness_true_n_per_m"], rel=0.02)


def test_without_a_frequency_the_sweep_is_as_slow_as_the_joint_asks_for(capsys, tmp_path):
    asked = ("identify", "--profile", "kang-2023", "--backend", "plant", "--duration-s", "2", "--runs", tmp_path)
    code, answer, _ = call_json(capsys, *asked)
    assert code == 0
    assert answer["backlash"]["width_m"] == pytest.approx(15.2e-3, rel=0.02)
    code, answer, _ = call_json(capsys, *asked, "--frequency-hz", "1")
    assert code == 2
    assert "ask for at most 0.208 Hz" in answer["error"]["message"]


def test_a_stage_of_one_axis_runs_behind_the_value_seam(capsys, tmp_path):
    code, answer, _ = call_json(
        capsys, "run", "-t", "sine", "--profile", "single-axis", "--backend", "plant", "--runs", tmp_path
    )
    assert code == 0
    assert answer["backlash"] is None
    assert answer["motions"][0]["law"] == "pid"


def test_a_file_of_positions_is_followed(capsys, tmp_path):
    file = tmp_path / "there-and-back.csv"
    file.write_text("t_s,position_m\n0,0\n1,0.01\n2,0.02\n3,0.01\n4,0\n")
    code, answer, _ = call_json(capsys, "run", "-t", file, "--backend", "plant", "--runs", tmp_path / "runs")
    assert code == 0
    assert answer["motions"][0]["trajectory"] == "there-and-back"


def test_a_jog_over_the_wire_ends_where_it_should(capsys, tmp_path):
    code, answer, _ = call_json(capsys, "jog", "--distance-m", "0.002", "--backend", "batch", "--runs", tmp_path)
    assert code == 0
    run = read_run(Path(answer["run"]))
    moves = [one for one in segments(run) if one.name.startswith("moving to")]
    assert len(moves) == 1
    last = run.rows[moves[0].first_row + moves[0].rows_count - 1]
    first = run.rows[moves[0].first_row]
    assert last["end_position_m"] - first["setpoint_position_m"] == pytest.approx(0.002, abs=1e-6)


def test_a_table_from_elsewhere_becomes_a_run(capsys, tmp_path):
    table = tmp_path / "bench.csv"
    table.write_text("time,laser\n" + "".join(f"{k * 0.001:.3f},{k * 0.01:.2f}\n" for k in range(50)))
    arguments = ["runs", "import", table, "--column", "t_ns=time:s", "--column", "end_position_m=laser:mm"]
    code, answer, _ = call_json(capsys, *arguments, "--runs", tmp_path / "runs")
    assert code == 0
    assert answer["rows_count"] == 50
    rows = read_run(Path(answer["folder"])).rows
    assert rows["end_position_m"][49] == pytest.approx(0.49e-3)
    code, refused, _ = call_json(capsys, "runs", "plot", answer["folder"])
    assert code == 2
    assert "no motions" in refused["error"]["message"]
    code, _, _ = call_json(capsys, "runs", "import", table, "--runs", tmp_path / "runs")
    assert code == 2


def test_profiles_are_listed_checked_and_shown(capsys):
    code, answer, _ = call_json(capsys, "profile", "list")
    assert code == 0
    assert {"oled-printer", "kang-2023", "single-axis"} <= {one["name"] for one in answer["profiles"]}
    code, answer, _ = call_json(capsys, "profile", "check", "oled-printer")
    assert code == 0
    assert re.fullmatch("[0-9a-f]{64}", answer["sha256"])
    assert answer["limp_deceleration_m_per_s2"] == pytest.approx(0.097, abs=1e-3)
    assert "brakes at 2 m/s^2, and a limp micro keeps off its stops up to 0.097 m/s^2" in " ".join(
        call(capsys, "profile", "check", "oled-printer")[1].split()
    )
    code, answer, _ = call_json(capsys, "profile", "show", "oled-printer")
    assert code == 0
    assert answer["profile"]["control"]["pid_bandwidth_hz"] == 50.0  # a default, filled in
    assert "pid_bandwidth_hz = 50" in call(capsys, "profile", "show", "oled-printer")[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("jog", "--distance-m", 0.5), "--distance-m is 0.5, from the homed zero; the travel of oled-printer"),
        (("jog", "--distance-m", "nan"), "--distance-m is nan"),
        (("identify", "--frequency-hz", 0.05, "--duration-s", 2), "take 40 s; give a longer duration_s"),
        (("identify", "--profile", "single-axis"), "this stage has no micro"),
    ],
)
def test_what_no_stage_of_this_profile_can_do_opens_none(capsys, tmp_path, arguments, said):
    code, answer, _ = call_json(capsys, *arguments, "--in-place", "--backend", "batch", "--runs", tmp_path / "runs")
    assert (code, said in answer["error"]["message"]) == (2, True), answer
    assert not (tmp_path / "runs").exists()
