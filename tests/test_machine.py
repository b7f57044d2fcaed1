"""Machines: what the rig is differs from what is believed as real machines do, and bad files are refused."""

import math
import tomllib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.framers import framer_for
from drivers.reading import END_VALID, MACRO_VALID
from sim_backend.machine import MACHINES_FOLDER, list_machines, load_machine, machine_path_for
from sim_backend.sensor_lines import Sample, writer_for
from stagectl import plant
from stagectl.compose import effect_parameters, structure_of
from stagectl.errors import ProfileError
from stagectl.profile import PROFILES_FOLDER, load_profile
from tests.toml_text import ABSENT, changed, dotted, numbers_in

SHIPPED = ("kang-2023", "oled-printer", "oled-printer-umd2", "single-axis")
OLED = MACHINES_FOLDER / "oled-printer.toml"
LEAVES = [
    (name, location)
    for name in SHIPPED
    for location in numbers_in(tomllib.loads((MACHINES_FOLDER / f"{name}.toml").read_text()))
]


def refusal(path: Path, text: str) -> str:
    """Write `text` to `path`, load it, and return what the ProfileError says."""
    path.write_text(text)
    with pytest.raises(ProfileError) as caught:
        load_machine(path)
    return str(caught.value)


@pytest.fixture
def bench(tmp_path, monkeypatch) -> Path:
    """Path of a machine in the folder that errors are relative to."""
    monkeypatch.chdir(tmp_path)
    return tmp_path / "bench.toml"


# --- what is shipped


def test_every_profile_has_its_machine():
    assert set(list_machines()) == {path.stem for path in PROFILES_FOLDER.glob("*.toml")}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_machine_loads_by_name_and_by_path(name):
    machine = load_machine(name)
    assert machine.name == name
    assert machine_path_for(name) == MACHINES_FOLDER / f"{name}.toml"
    assert load_machine(machine_path_for(name)) == machine
    for axis in machine.axes:
        assert machine.eds_path(axis).is_file()


@pytest.mark.parametrize("name", SHIPPED)
def test_plant_and_composer_take_the_machine(name):
    machine = load_machine(name)
    parameters = plant.parameters(machine, seed=3)
    assert all(math.isfinite(value) for value in parameters[0])
    assert plant.init(machine)[0]["macro_position_m"] == machine.start.macro_position_m
    assert len(structure_of(machine.effects)) == len(machine.effects)
    assert all(math.isfinite(value) for value in effect_parameters(machine.effects))


@pytest.mark.parametrize("name", SHIPPED)
def test_belief_and_truth_differ_as_real_machines_do(name):
    profile, machine = load_profile(name), load_machine(name)
    assert machine.axes == profile.axes
    for axis in profile.axes:
        believed, true = getattr(profile, axis), getattr(machine, axis)
        assert abs(true.mass_kg / believed.mass_kg - 1.0) == pytest.approx(0.01, abs=1e-6)
        constant = believed.rated_force_n / believed.rated_current_a
        assert abs(true.force_constant_n_per_a / constant - 1.0) == pytest.approx(0.01, abs=0.0005)
        assert true.node_id == believed.node_id
        assert true.eds == believed.eds
        assert true.rated_current_a == believed.rated_current_a
        # the drive can make the force that the profile allows, up to the error of its constant
        assert true.current_limit_a * constant >= believed.force_limit_n
    assert machine.macro.encoder_step_m == profile.macro.encoder_step_m
    low_m, high_m = profile.macro.travel_m
    assert machine.macro.travel_m[0] < low_m < machine.start.macro_position_m < high_m < machine.macro.travel_m[1]
    believed_effects = {(effect["name"], effect["acts_on"]) for effect in profile.effects}
    true_effects = {(effect["name"], effect["acts_on"]) for effect in machine.effects}
    assert believed_effects < true_effects


@pytest.mark.parametrize("name", [name for name in SHIPPED if name != "single-axis"])
def test_true_backlash_is_elsewhere_in_the_believed_range(name):
    profile, machine = load_profile(name), load_machine(name)
    believed, true = profile.backlash, machine.backlash
    for side in ("left_m", "right_m"):
        off_m = abs(getattr(true, side) - getattr(believed, side))
        assert 0.0 < off_m < believed.width_sd_m
    for side in ("left_stiffness_n_per_m", "right_stiffness_n_per_m"):
        assert 0.015 < abs(getattr(true, side) / getattr(believed, side) - 1.0) < 0.05


@pytest.mark.parametrize("name", SHIPPED)
def test_device_speaks_the_format_that_the_profile_expects(name):
    believed, true = load_profile(name).interferometer, load_machine(name).interferometer
    assert true.format == believed.format
    assert true.rate_hz == believed.rate_hz
    assert true.interpolation_speed_m_per_s == believed.interpolation_speed_m_per_s
    assert true.transport_s == believed.transport_s
    if believed.format == "umd2":
        assert true.counts_per_wavelength == believed.frame.counts_per_wavelength == 8.0
    else:
        scales = {field.counts_per_wavelength for field in believed.frame.fields if field.role in ("macro", "end")}
        assert scales == {true.counts_per_wavelength}


@pytest.mark.parametrize("name", SHIPPED)
def test_lines_of_the_machine_are_read_as_the_profile_says(name):
    machine, profile = load_machine(name), load_profile(name)
    writer = writer_for(machine.interferometer, machine.air, len(machine.axes))
    framer = framer_for(profile.effective()["interferometer"])
    both = machine.micro is not None
    readings = []
    for sequence in range(20):
        sample = Sample(sequence, 1000.0 + sequence, -2000.0 - sequence, False, not both, True, True)
        readings += framer.feed(writer.line(sample))
    assert len(readings) == 20
    assert framer.counters.bytes_discarded == 0
    assert readings[-1].macro_counts == 1019.0
    assert readings[-1].flags == (MACRO_VALID | END_VALID if both else MACRO_VALID)
    if both:
        assert readings[-1].end_counts == -2019.0


# --- bad input

BAD_NUMBERS = st.sampled_from([math.nan, math.inf, -math.inf, True, False, "70", "nan", "", [], {}])


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(leaf=st.sampled_from(LEAVES), bad=BAD_NUMBERS)
def test_bad_number_in_any_shipped_machine_is_refused_by_name(leaf, bad, tmp_path):
    name, location = leaf
    text = refusal(tmp_path / "bad.toml", changed(MACHINES_FOLDER / f"{name}.toml", {dotted(location): bad}))
    assert [line for line in text.splitlines() if f"bad.toml: {dotted(location)} = " in line], text


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"macro.travel_m": [0.5, -0.5]},
            "macro.travel_m = [0.5, -0.5]: lower end must be below the upper; swap them",
        ),
        (
            {"macro.mass_kg": ABSENT, "macro.mass": 70},
            "macro.mass = 70: the name must end in its unit, kg; write mass_kg, in kg",
        ),
        (
            {"interferometer.clock_ppn": 20.0},
            "interferometer.clock_ppn = 20.0: is not a key of this table; did you mean clock_ppm (1e-6)?",
        ),
        (
            {"micro.node_id": 1},
            "micro.node_id = 1: is macro.node_id as well, and a CANopen node id belongs to one drive;"
            " give each drive its own",
        ),
        (
            {"macro.index_position_m": 0.6},
            "macro.index_position_m = 0.6: must be inside travel_m = [-0.5, 0.5], or homing never finds it; move it",
        ),
        (
            {"macro.rated_current_a": 25.0},
            "macro.rated_current_a = 25.0: is above current_limit_a = 20; lower it or raise the limit",
        ),
        (
            {"micro.current_limit_a": 100.0},
            "micro.current_limit_a = 100.0: the winding alone takes 76 V of supply_v = 48; lower it or"
            " raise the supply",
        ),
        (
            {"micro.stroke_m": [-0.0001, 0.001]},
            "micro.stroke_m = [-0.0001, 0.001]: must reach from below -0.0001713 to above 2.79e-05 m, or the joint"
            " never touches; widen it, or correct backlash",
        ),
        (
            {"start.relative_position_m": 0.002},
            "start.relative_position_m = 0.002: must be inside micro.stroke_m = [-0.001, 0.001]; move it",
        ),
        (
            {"start.macro_position_m": -0.5},
            "start.macro_position_m = -0.5: must be inside macro.travel_m = [-0.5, 0.5]; move it",
        ),
        (
            {"interferometer.interpolation_speed_m_per_s": 1e-5},
            "interferometer.interpolation_speed_m_per_s = 1e-05: is known of the format umd2 only, not of syncfixed;"
            " remove it or correct format",
        ),
        (
            {"interferometer.transport": "usb"},
            "interferometer.transport = \"usb\": must be 'line', 'usb-125us' or 'ftdi-16ms'; choose one of them",
        ),
        (
            {"backlash": ABSENT},
            "backlash is missing: [micro] and [backlash] belong together; add it",
        ),
        (
            {"effects[2].pitch_m": 0.0},
            "effects[2].pitch_m = 0.0: must be 0.0001 to 1 m; correct it, in m",
        ),
        ({"start": ABSENT}, "start is missing; add it"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_bad_input_is_refused(bench, changes, text):
    assert refusal(bench, changed(OLED, changes)) == f"bench.toml: {text}"


def test_eds_missing(bench):
    text = refusal(bench, changed(OLED, {"micro.eds": "nowhere.eds"}))
    assert text.startswith('bench.toml: micro.eds = "nowhere.eds": there is no such file in ')


def test_micro_taken_out_names_everything_that_needs_it(bench):
    lines = refusal(bench, changed(OLED, {"micro": ABSENT})).splitlines()
    assert [line.split(": ")[1].split(" = ")[0] for line in lines] == [
        "micro is missing",
        "effects[1].name",
        "effects[4].name",
    ]


def test_profile_without_a_machine_says_what_there_is():
    with pytest.raises(
        ProfileError, match=r"profile oled-prnter: the rig has no machine .* it has .*oled-printer.*\. Give"
    ):
        machine_path_for("oled-prnter")
