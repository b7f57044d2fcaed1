"""Runs as a user meets them: named, listed, shown, taken out to CSV, Parquet and MAT, taken in from CSV and MAT."""

import csv
import struct
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pyarrow.parquet as parquet
import pytest
from scipy.io import loadmat, savemat

from stagectl.errors import RecordError, RequestError
from stagectl.record import Recorder, read_run
from stagectl.row import ROW, new_rows
from stagectl.runs import ending, export, import_table, list_runs, new_run_folder, profile_of, show
from stagectl.signals import Stop

HARD_FLOATS = [0.1, 1 / 3, -0.0, 5e-324, 1.7976931348623157e308, 2.0**-1022, 123456789.12345679, 1e-9, np.nan, np.inf]


@pytest.fixture
def folder(tmp_path):
    rows = new_rows(len(HARD_FLOATS))
    rows["t_ns"] = 9_007_199_254_740_993 + np.arange(len(rows)) * 1_000_000  # 2^53 + 1: no double holds it
    rows["cycle"] = np.arange(len(rows))
    rows["end_position_m"] = HARD_FLOATS
    rows["macro_tpdo"] = np.arange(8)
    rows["macro_tpdo_count"] = 8
    rows["lateness_ns"] = np.arange(len(rows)) * 100
    rows["cycles_missed"] = 2
    recorder = Recorder(tmp_path / "runs" / "2026-11-20T09-14-03-sine", {"profile": {"name": "oled-printer"}})
    recorder.event("law", 1)
    recorder.append(rows)
    recorder.close({"stop": Stop.SENSOR_AGE})
    return recorder.folder


def bits(value):
    return struct.pack("<d", value)


def test_a_run_is_named_after_its_beginning(tmp_path):
    begun = datetime(2026, 11, 20, 11, 14, 3, tzinfo=timezone(timedelta(hours=2)))
    first = new_run_folder(tmp_path, "sine", begun)
    assert first == tmp_path / "2026-11-20T09-14-03-sine"
    first.mkdir()
    assert new_run_folder(tmp_path, "sine", begun) == tmp_path / "2026-11-20T09-14-03-sine-2"
    assert abs(datetime.now(UTC) - datetime.strptime(new_run_folder(tmp_path, "x").name, "%Y-%m-%dT%H-%M-%S-x").replace(
        tzinfo=UTC)) < timedelta(minutes=5)  # fmt: skip


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "with space", "-dash"])
def test_a_run_name_stays_in_its_folder(tmp_path, name):
    with pytest.raises(RequestError, match="run name"):
        new_run_folder(tmp_path, name)


def test_list_tells_whole_crashed_living_and_damaged_runs(folder):
    root = folder.parent
    crashed = Recorder(root / "crashed", {"profile": "kang-2023"})
    rows = new_rows(400)
    rows["t_ns"] = np.arange(400) * 1_000_000
    crashed.append(rows)
    crashed.abandon()
    living = Recorder(root / "living", {})
    (root / "not-a-run").mkdir()
    (root / "z-torn").mkdir()
    (root / "z-torn" / "manifest.json").write_text('{"na')
    found = {summary.folder.name: summary for summary in list_runs(root)}
    living.close()
    assert list(found) == sorted(found)
    whole = found[folder.name]
    assert (whole.state, whole.rows_count, whole.profile) == ("closed", 10, "oled-printer")
    assert whole.duration_s == pytest.approx(9e-3)
    assert (whole.stop, whole.text) == ("SENSOR_AGE", "no valid interferometer sample for too long")
    assert (found["crashed"].state, found["crashed"].rows_count) == ("crashed", 400)
    assert found["crashed"].duration_s == pytest.approx(0.399)
    assert found["living"].state == "recording"
    assert found["not-a-run"].state == "damaged"
    assert "manifest.json" in found["z-torn"].note
    assert list_runs(root / "nowhere") == []


@pytest.mark.parametrize(
    ("end", "stop", "text"),
    [
        ({"stop": "NONE", "detail": ""}, "NONE", "nothing stopped it"),
        ({"stop": "OPERATOR", "detail": ""}, "OPERATOR", "the operator asked to stop"),
        (
            {"stop": "THERMAL", "detail": "micro at 81.0 N rms, limit 80 N; let it cool"},
            "THERMAL",
            "a motor reached its thermal limit: micro at 81.0 N rms, limit 80 N; let it cool",
        ),
        ({"stop": "NONE", "error": "DriveError: homing: no edge"}, "NONE", "DriveError: homing: no edge"),
        ({"error": "RecordError: disk"}, "", "RecordError: disk"),
        ({"stop": int(Stop.LEASE)}, "LEASE", "the lease on motion ran out"),
        ({"stop": "OF_A_LATER_VERSION"}, "OF_A_LATER_VERSION", ""),
        ({}, "", ""),
    ],
)
def test_a_run_says_how_it_ended_with_its_numbers(end, stop, text):
    assert ending({"end": end}) == (stop, text)


def test_a_folder_of_runs_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="is a file"):
        list_runs(tmp_path / "file")


def test_a_profile_of_another_version_is_said(folder):
    with pytest.raises(RecordError, match=r"manifest\.json: the profile in it can't be read by this version"):
        profile_of(read_run(folder))


def test_show_describes_a_run(folder):
    description = show(folder)
    assert description["rows_count"] == 10
    assert description["events"] == {"law": 1}
    assert description["truncated"] is False
    assert description["health"]["cycles_missed"] == 2
    assert description["health"]["lateness_ns"]["p50"] == 450.0
    assert description["health"]["lateness_ns"]["max"] == 900.0
    assert description["manifest"]["record"]["rows_count"] == 10


def test_csv_loses_no_bit(folder):
    path = export(folder, "csv")
    assert path == folder / "samples.csv"
    with open(path, newline="") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == ROW.names
    assert [bits(float(line["end_position_m"])) for line in table] == [bits(value) for value in HARD_FLOATS]
    assert int(table[3]["t_ns"]) == 9_007_199_254_740_993 + 3_000_000
    assert table[0]["macro_tpdo"] == "0001020304050607"


def test_parquet_loses_no_bit(folder, tmp_path):
    path = export(folder, "parquet", out=tmp_path / "elsewhere" / "x.parquet")
    table = parquet.read_table(path)
    assert tuple(table.column_names) == ROW.names
    assert [bits(value) for value in table["end_position_m"].to_pylist()] == [bits(value) for value in HARD_FLOATS]
    assert table["t_ns"][0].as_py() == 9_007_199_254_740_993
    assert table["macro_tpdo"][9].as_py() == bytes(range(8))
    assert table.schema.field("end_position_m").metadata[b"unit"] == b"m"


def test_mat_loses_no_bit(folder):
    content = loadmat(export(folder, "mat"))
    assert {name for name in content if not name.startswith("__")} == set(ROW.names)
    assert [bits(value) for value in content["end_position_m"][:, 0]] == [bits(value) for value in HARD_FLOATS]
    assert content["t_ns"].dtype == np.int64
    assert content["t_ns"][0, 0] == 9_007_199_254_740_993
    assert content["macro_tpdo"].dtype == np.uint8
    assert content["macro_tpdo"].tolist() == [list(range(8))] * 10


@pytest.mark.parametrize("format", ["csv", "parquet", "mat"])
def test_long_runs_are_exported_whole(tmp_path, format):
    rows = new_rows(40_000)
    rows["t_ns"] = np.arange(len(rows)) * 1_000_000
    rows["end_position_m"] = np.random.default_rng(1).normal(size=len(rows))
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows)
    path = export(tmp_path / "run", format, ["t_ns", "end_position_m"])
    if format == "csv":
        columns = np.genfromtxt(path, delimiter=",", names=True)
        positions = columns["end_position_m"]
    elif format == "parquet":
        positions = parquet.read_table(path)["end_position_m"].to_numpy()
    else:
        positions = loadmat(path)["end_position_m"][:, 0]
    assert np.array_equal(positions, rows["end_position_m"])


def test_wrong_exports_say_what_to_ask_for(folder, tmp_path):
    with pytest.raises(RequestError, match="csv, parquet, mat"):
        export(folder, "xlsx")
    with pytest.raises(RequestError, match="did you mean end_position_m"):
        export(folder, "csv", ["t_ns", "end_position_mm"])
    with pytest.raises(RequestError, match="asked for twice"):
        export(folder, "csv", ["t_ns", "t_ns"])
    with pytest.raises(RecordError, match="not a run folder"):
        export(tmp_path, "csv")
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="can't be written"):
        export(folder, "csv", out=tmp_path / "file" / "x.csv")
    with pytest.raises(RecordError, match="No space left"):
        export_to_full_device(folder, tmp_path)


def export_to_full_device(folder, tmp_path):
    (tmp_path / ".x.csv.part").symlink_to("/dev/full")
    export(folder, "csv", out=tmp_path / "x.csv")


def test_a_failed_export_leaves_no_file(folder, tmp_path):
    with pytest.raises(RecordError):
        export_to_full_device(folder, tmp_path)
    assert not (tmp_path / "x.csv").exists()
    assert not (tmp_path / ".x.csv.part").is_symlink()


def write_csv(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_import_converts_to_si_and_says_how(tmp_path):
    path = write_csv(tmp_path / "old.csv", "time,qm,qg,vir\n0.000,1.5,2,0.1\n0.001,1.6,2,0.2\n0.002,-1.7,3,0.3\n")
    imported = import_table(
        path,
        ["t_ns=time:s", "end_position_m=qm:mm", "setpoint_position_m=qg:um", "macro_force_n=vir:35.1507 N"],
        tmp_path / "run",
    )
    run = read_run(imported.folder)
    assert run.rows["t_ns"].tolist() == [0, 1_000_000, 2_000_000]
    assert run.rows["end_position_m"].tolist() == [0.0015, 0.0016, -0.0017]
    assert run.rows["setpoint_position_m"].tolist() == pytest.approx([2e-6, 2e-6, 3e-6], rel=1e-15)
    assert run.rows["macro_force_n"].tolist() == [0.1 * 35.1507, 0.2 * 35.1507, 0.3 * 35.1507]
    assert run.rows["cycle"].tolist() == [0, 1, 2]
    assert np.all(np.isnan(run.rows["macro_position_m"]))
    assert "macro_position_m" in run.missing_fields
    assert "end_position_m" not in run.missing_fields
    assert "end_position_m = qm [mm] x 0.001, in m" in imported.conversions
    assert run.manifest["import"]["conversions"] == list(imported.conversions)
    assert imported.remarks == ()
    assert export(imported.folder, "csv").read_text().splitlines()[0] == (
        "t_ns,cycle,setpoint_position_m,macro_force_n".replace("cycle", "cycle,end_position_m")
    )


def test_import_takes_its_map_from_toml(tmp_path):
    path = write_csv(tmp_path / "t.csv", "t,x:1\n1,4\n2,5\n")
    toml = tmp_path / "map.toml"
    toml.write_text('t_ns = "t:ms"\nend_position_m = { column = "x:1", unit = "nm" }\n')
    imported = import_table(path, toml, tmp_path / "run")
    run = read_run(imported.folder)
    assert run.rows["t_ns"].tolist() == [1_000_000, 2_000_000]
    assert run.rows["end_position_m"].tolist() == [4 * 1e-9, 5 * 1e-9]


def test_export_and_import_give_the_same_bits(folder, tmp_path):
    source = read_run(folder).rows[:8]  # without nan and inf, which an import refuses
    with Recorder(tmp_path / "finite", {}) as recorder:
        recorder.append(source)
    items = ["t_ns=t_ns:ns", "end_position_m=end_position_m:m", "lateness_ns=lateness_ns:ns"]
    for format in ("csv", "mat"):
        path = export(tmp_path / "finite", format)
        rows = read_run(import_table(path, items, tmp_path / format).folder).rows
        for name in ("t_ns", "end_position_m", "lateness_ns"):
            assert rows[name].tobytes() == source[name].tobytes(), (format, name)


def test_import_reads_vectors_and_structs_of_mat(tmp_path):
    savemat(tmp_path / "m.mat", {"t": np.arange(5.0)[:, None], "log": {"qm": np.arange(5.0)}, "kp": 160.18})
    imported = import_table(tmp_path / "m.mat", ["t_ns=t:ms", "end_position_m=log.qm:mm"], tmp_path / "run")
    assert read_run(imported.folder).rows["end_position_m"].tolist() == [0.0, 0.001, 0.002, 0.003, 0.004]


def test_import_reads_german_tables(tmp_path):
    path = write_csv(tmp_path / "de.csv", "Zeit;Weg\n0,000;1,5\n0,001;1,75\n")
    imported = import_table(path, ["t_ns=Zeit:s", "end_position_m=Weg:mm"], tmp_path / "run")
    assert read_run(imported.folder).rows["end_position_m"].tolist() == [0.0015, 0.00175]
    assert "read with decimal commas" in imported.remarks


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,x\n0,0.0\n0.001,250.0\n0.002,251.0\n", "looks like mm read as m"),  # 250 mm of travel
        ("t,x\n0,0.0\n0.001,0.2\n0.002,0.4\n", "moves at 200 m/s"),  # 0.2 m/s written in mm
        ("t,x\n0,0.0\n1,0.0\n2,0.0\n", "looks like ms read as s"),
    ],
)
def test_import_says_what_looks_like_another_unit(tmp_path, text, said):
    path = write_csv(tmp_path / "t.csv", text)
    imported = import_table(path, ["t_ns=t:s", "end_position_m=x:m"], tmp_path / "run")
    assert any(said in remark for remark in imported.remarks)
    assert read_run(imported.folder).manifest["import"]["remarks"] == list(imported.remarks)


@pytest.mark.parametrize(
    ("text", "items", "error", "said"),
    [
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "end_position_m=qn:m"], RequestError, "no column 'qn'.*there are t, qm"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "end_positon_m=qm:m"], RequestError, "did you mean end_position_m"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "macro_tpdo=qm:1"], RequestError, "no field of a row"),
        ("t,qm\n0,1\n1,2\n", ["end_position_m=qm:m"], RequestError, "t_ns is missing"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "end_position_m=qm"], RequestError, "states no unit"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "end_position_m=qm:N"], RequestError, "use one of m, mm"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "end_position_m=qm:nan m"], RequestError, "finite and not zero"),
        ("t,qm\n0,1\n1,2\n", ["t_ns=t:s", "t_ns=qm:s"], RequestError, "mapped twice"),
        ("t,qm\n0,1\n1,2\n", ["t_ns"], RequestError, "name=column:unit"),
        ("t,qm\n0,1\n1,nan\n2,\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "2 of 3 values.*data row 2"),
        ("t,qm\n0,1\n1,inf\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "infinite"),
        ("t,qm\n0,1\n1,abc\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "'abc' in data row 2"),
        ("t,qm\n0,1\n2,2\n1,3\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "does not rise after data row 2"),
        ("t,qm\n0,1\n0,2\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "does not rise after data row 1"),
        ("t,qm\n0,1\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "at least 2"),
        ("t,qm\n", ["t_ns=t:s", "end_position_m=qm:m"], RecordError, "at least 2"),
        ("", ["t_ns=t:s"], RecordError, "not a CSV table"),
        ("t,t\n0,1\n1,2\n", ["t_ns=t:s"], RecordError, "two columns are called 't'"),
        ("t,qm\n0,1\n1,2,3\n", ["t_ns=t:s"], RecordError, "not a CSV table"),
        ("t,n\n0,1\n1,2.5\n", ["t_ns=t:s", "homing_id=n:1"], RecordError, "not a whole number"),
        ("t,n\n0,1\n1e290,2\n", ["t_ns=t:s"], RecordError, "beyond 64-bit"),
    ],
)
def test_import_refuses_and_leaves_nothing(tmp_path, text, items, error, said):
    path = write_csv(tmp_path / "t.csv", text)
    with pytest.raises(error, match=said):
        import_table(path, items, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_import_of_files_that_are_no_tables(tmp_path):
    with pytest.raises(RecordError, match="can't be read"):
        import_table(tmp_path / "none.csv", ["t_ns=t:s"], tmp_path / "run")
    with pytest.raises(RecordError, match="can't be read"):
        import_table(tmp_path / "none.mat", ["t_ns=t:s"], tmp_path / "run")
    (tmp_path / "x.mat").write_bytes(b"not a mat file at all, but long enough to be looked at" * 10)
    with pytest.raises(RecordError, match="save it again with -v7"):
        import_table(tmp_path / "x.mat", ["t_ns=t:s"], tmp_path / "run")
    (tmp_path / "v73.mat").write_bytes(
        b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H2s", 0x0200, b"IM") + bytes(900)
    )
    with pytest.raises(RecordError, match=r"MAT 7\.3"):
        import_table(tmp_path / "v73.mat", ["t_ns=t:s"], tmp_path / "run")
    with pytest.raises(RequestError, match=r"a table is \.csv or \.mat"):
        import_table(tmp_path / "x.xlsx", ["t_ns=t:s"], tmp_path / "run")
    with pytest.raises(RequestError, match="not a readable column map"):
        import_table(tmp_path / "x.mat", tmp_path / "none.toml", tmp_path / "run")
    savemat(tmp_path / "two.mat", {"t": np.arange(5.0), "x": np.arange(4.0)})
    with pytest.raises(RecordError, match="has 4 values and the time has 5"):
        import_table(tmp_path / "two.mat", ["t_ns=t:s", "end_position_m=x:m"], tmp_path / "run")


def test_import_never_writes_over_a_run(folder, tmp_path):
    path = write_csv(tmp_path / "t.csv", "t\n0\n1\n")
    with pytest.raises(RecordError, match="already holds a run"):
        import_table(path, ["t_ns=t:ms"], folder)
