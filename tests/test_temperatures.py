"""The drives' temperatures on the controller's side: when they are asked for, warnings, and drives that don't say."""

import json
import re

import pytest

from sim_backend.machine import Winding
from stagectl import temperatures
from stagectl.commands.profiles import check_eds
from stagectl.errors import DriveError, LinkError, ProfileError
from stagectl.profile import PROFILES_FOLDER, Temperature, load_profile
from stagectl.record import read_run
from stagectl.temperatures import BACK, EVERY_S, UNREAD, WARNING, Temperatures, answer_s
from tests.stage import with_values
from tests.struck_stage import Stage
from tests.toml_text import ABSENT, changed

TABLE = Temperature(index=0x2010, subindex=0, degc_per_count=0.1, warning_degc=80.0)


class Drives:
    """What drives say, and what was asked of them."""

    def __init__(self, **degc):
        self.degc = degc
        self.asked = []
        tables = {axis: TABLE for axis in degc}
        self.temperatures = Temperatures(tables, self.read)

    def read(self, axis, table):
        self.asked.append(axis)
        found = self.degc[axis]
        if isinstance(found, Exception):
            raise found
        return round(found / table.degc_per_count)

    def look(self, now_s, absent=()):
        return self.temperatures.look(now_s, absent)


# ---- when ---------------------------------------------------------------------------------------------------------


def test_each_axis_is_asked_at_once_and_then_every_5_s_and_never_two_in_one_look():
    drives = Drives(macro=30.0, micro=25.0)
    instants = {"macro": [], "micro": []}
    for k in range(1000):
        before = len(drives.asked)
        assert drives.look(0.02 * k) == []
        taken = drives.asked[before:]
        assert len(taken) <= 1
        for axis in taken:
            instants[axis].append(0.02 * k)
    assert instants["macro"][:2] == [0.0, pytest.approx(EVERY_S)]
    assert instants["micro"][:2] == [pytest.approx(0.02), pytest.approx(0.02 + EVERY_S)]
    assert len(instants["macro"]) == len(instants["micro"]) == 4
    assert drives.temperatures.newest["macro"].degc == pytest.approx(30.0)
    assert drives.temperatures.newest["micro"].t_s == pytest.approx(instants["micro"][-1])


def test_a_drive_whose_heartbeat_is_missing_is_not_asked():
    drives = Drives(macro=30.0, micro=25.0)
    for k in range(10):
        drives.look(float(k), absent=["macro"])
    assert set(drives.asked) == {"micro"}
    drives.look(10.0)
    assert drives.asked[-1] == "macro"


def test_an_answer_is_not_waited_for_until_the_servo_stops_the_stage(single_profile):
    assert answer_s(single_profile.trip) == 0.05
    for key in ("supervisor_silence_s", "lease_s"):
        trip = with_values(single_profile, **{f"trip__{key}": 0.05}).trip
        assert 0.02 + answer_s(trip) < 0.05  # a pump of 20 ms, and the answer


# ---- warnings -----------------------------------------------------------------------------------------------------


def test_a_warning_is_said_once_a_crossing_and_taken_back_2_k_below():
    drives = Drives(macro=20.0)
    told = []
    degrees = (79.9, 80.0, 95.0, 80.0, 79.9, 78.1, 80.0, 78.0, 77.9, 79.9, 80.0, 77.0)
    for k, degc in enumerate(degrees):
        drives.degc["macro"] = degc
        told += [(degc, news.event) for news in drives.look(k * EVERY_S)]
    assert told == [(80.0, WARNING), (77.9, BACK), (80.0, WARNING), (77.0, BACK)]
    drives.degc["macro"] = 81.2
    (news,) = drives.look(len(degrees) * EVERY_S)
    assert news.text == (
        "macro: 81.2 degC, limit macro.temperature.warning_degc = 80 degC; have it move less, or cool the motor"
    )
    assert news.fields == {"axis": "macro", "degc": pytest.approx(81.2), "warning_degc": 80.0}
    assert drives.temperatures.newest["macro"].warning


def test_without_a_warning_in_the_profile_none_is_said():
    drives = Drives(macro=300.0)
    drives.temperatures = Temperatures({"macro": TABLE.model_copy(update={"warning_degc": None})}, drives.read)
    assert drives.look(0.0) == []
    assert not drives.temperatures.newest["macro"].warning


# ---- drives that don't say ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [DriveError("refused"), LinkError("no answer")])
def test_after_three_reads_in_a_row_without_an_answer_it_is_not_asked_any_more_and_said_once(error):
    drives = Drives(macro=30.0, micro=25.0)
    told = []
    answers = [30.0, error, error, 31.0, error, error, error, 32.0, 33.0, 34.0]
    for k, answer in enumerate(answers):
        drives.degc["macro"] = answer
        for looks in (0.0, 0.02):
            told += [(k, news) for news in drives.look(k * (EVERY_S + 0.1) + looks)]
        assert ("macro" in drives.temperatures.newest) == (k < 6)
    ((when, news),) = told
    assert (when, news.event, news.fields["axis"]) == (6, UNREAD, "macro")
    assert str(error) in news.text
    assert drives.asked.count("macro") == 7
    assert drives.asked.count("micro") == len(answers)


# ---- profiles -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"macro.temperature.index": 0x1018}, r"macro.temperature.index = 4120: must be 8192 to 40959"),
        ({"macro.temperature.degc_per_count": 0.0}, r"degc_per_count = 0.0: must be above 0 and at most 10"),
        ({"macro.temperature.subindex": 255}, r"subindex = 255: must be 0 to 254"),
        ({"macro.temperature.warning_degc": 1e4}, r"warning_degc = 10000.0: must be -40 to 300 degC"),
        ({"macro.temperature.degc_per_count": ABSENT}, r"macro.temperature.degc_per_count is missing"),
        ({"macro.temperature.limit_degc": 90.0}, r"macro.temperature.limit_degc"),
    ],
)
def test_a_wrong_table_is_refused_with_key_value_and_limit(tmp_path, changes, words):
    path = tmp_path / "single-axis.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", changes))
    with pytest.raises(ProfileError, match=words):
        load_profile(path)


def test_a_stage_needs_no_temperatures(tmp_path):
    path = tmp_path / "single-axis.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"macro.temperature": ABSENT}))
    assert load_profile(path).macro.temperature is None


@pytest.mark.parametrize(("index", "subindex"), [(0x2011, 0), (0x2010, 1)])
def test_an_object_that_the_drive_s_eds_lacks_is_refused_by_the_check(tmp_path, index, subindex):
    path = tmp_path / "single-axis.toml"
    where = {"macro.temperature.index": index, "macro.temperature.subindex": subindex}
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", where))
    check_eds(load_profile("single-axis"))
    with pytest.raises(
        ProfileError, match=rf"macro.eds = .*lacks what arming needs, as integers: 0x{index:X}:0{subindex}"
    ):
        check_eds(load_profile(path))


# ---- a stage in batch ---------------------------------------------------------------------------------------------


def warm_machine(machine):
    """The stage's machine with windings that a second of motion warms."""
    windings = {
        f"{axis}__winding": Winding(rise_at_rated_current_k=900.0, time_constant_s=0.5) for axis in ("macro", "micro")
    }
    return with_values(machine, **windings)


def events_of(folder, *names):
    lines = (folder / "events.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if event["event"] in names]


def test_commands_and_samples_are_the_same_to_the_last_bit_with_and_without(
    oled_profile, oled_machine, tmp_path, monkeypatch
):
    """Twenty readings a second in motion, against none."""
    monkeypatch.setattr(temperatures, "EVERY_S", 0.05)
    silent = with_values(oled_profile, macro__temperature=None, micro__temperature=None)
    rows = {}
    for name, profile in (("asked", oled_profile), ("left alone", silent)):
        one = Stage(tmp_path / name, profile, warm_machine(oled_machine))
        with one:
            one.arm()
            assert one.move().finished
            found = one.stage.temperatures
        rows[name] = read_run(tmp_path / name).rows
        assert set(found) == ({"macro", "micro"} if profile is oled_profile else set())
        if found:
            assert found["macro"][0].degc > 25.0
    asked, left_alone = rows["asked"], rows["left alone"]
    assert asked.size == left_alone.size > 1000
    for field in asked.dtype.names:
        assert asked[field].tobytes() == left_alone[field].tobytes(), field


def test_a_warm_winding_is_an_event_of_the_run_and_stops_nothing(oled_profile, oled_machine, tmp_path, monkeypatch):
    monkeypatch.setattr(temperatures, "EVERY_S", 0.05)
    profile = with_values(oled_profile, macro__temperature=TABLE.model_copy(update={"warning_degc": 26.0}))
    one = Stage(tmp_path / "run", profile, warm_machine(oled_machine))
    with one:
        one.arm()
        assert one.move().finished
        one.stage.pump(5.0)  # it cools, and is looked at once a pump
        one.stage.pump()
        said = one.stage.take_news()
        assert one.stage.take_news() == []
        assert not one.stage.temperatures["macro"][0].warning
        assert 0.0 <= one.stage.temperatures["macro"][1] < 1.0
    found = events_of(tmp_path / "run", WARNING, BACK)
    assert [event["event"] for event in found] == [news.event for news in said]
    assert [event["event"] for event in found][:1] == [WARNING]
    assert [event["event"] for event in found][-1:] == [BACK]
    assert found[0]["degc"] >= 26.0
    assert found[-1]["degc"] < 24.0


@pytest.mark.parametrize("kind", ["refused", "unanswered"])
def test_a_drive_that_does_not_say_is_left_alone_and_the_stage_goes_on(
    oled_profile, oled_machine, tmp_path, monkeypatch, kind
):
    monkeypatch.setattr(temperatures, "EVERY_S", 0.05)
    machine = with_values(oled_machine, macro__winding=None) if kind == "refused" else oled_machine
    one = Stage(tmp_path / "run", oled_profile, machine)
    with one:
        if kind == "unanswered":
            lose_answers_of(one.backend.wire.network_bus, 0x581, bytes.fromhex("10 20 00"))
        one.arm()
        assert one.move().finished
        found = one.stage.temperatures
        said = [news for news in one.stage.take_news() if news.event == UNREAD]
    assert set(found) == {"micro"}
    (event,) = events_of(tmp_path / "run", UNREAD)
    words = "the drive refused the read: .*0602 ?0000|Object does not exist" if kind == "refused" else "No SDO response"
    (news,) = said
    assert news.text == event["text"]
    assert re.search(words, news.text), news.text


def lose_answers_of(bus, can_id, place):
    """Have the answers of one drive about one object get lost on their way to the master."""
    put = bus.put

    def lose(frame_id, payload, t_ns):
        if frame_id != can_id or payload[1:4] != place:
            put(frame_id, payload, t_ns)

    bus.put = lose
