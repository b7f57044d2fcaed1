"""Profiles: what is shipped holds together, and what is wrong is refused with file, key, value, limit and remedy."""

import hashlib
import json
import math
import tomllib
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from drivers.framers import framer_for
from drivers.scale import counts_per_wavelength_of
from sim_backend.machine import Machine
from stagectl.errors import ProfileError
from stagectl.profile import (
    PROFILES_FOLDER,
    Profile,
    list_profiles,
    load_profile,
    profile_from_effective,
)
from stagectl.toml_file import Within
from stagectl.units import unit_of
from tests.toml_text import ABSENT, changed, dotted, location_of, numbers_in, toml_of

SHIPPED = ("kang-2023", "oled-printer", "oled-printer-umd2", "single-axis")
OLED = PROFILES_FOLDER / "oled-printer.toml"
LEAVES = [
    (name, location)
    for name in SHIPPED
    for location in numbers_in(tomllib.loads((PROFILES_FOLDER / f"{name}.toml").read_text()))
]


def refusal(path: Path, text: str) -> str:
    """Write `text` to `path`, load it, and return what the ProfileError says."""
    path.write_text(text)
    with pytest.raises(ProfileError) as caught:
        load_profile(path)
    return str(caught.value)


@pytest.fixture
def bench(tmp_path, monkeypatch) -> Path:
    """Path of a profile in a folder of its own, shown as `profiles/bench.toml`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "profiles").mkdir()
    return tmp_path / "profiles" / "bench.toml"


# --- what is shipped


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profile_loads_by_name_and_by_path(name):
    profile = load_profile(name)
    path = PROFILES_FOLDER / f"{name}.toml"
    assert profile.name == name
    assert profile.source_path == path
    assert profile.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert load_profile(path) == profile
    assert load_profile(str(path)) == profile


def test_list_profiles_holds_all_shipped():
    assert set(SHIPPED) <= set(list_profiles())


@pytest.mark.parametrize("name", SHIPPED)
def test_effective_values_are_json_hold_defaults_and_load_again(name):
    profile = load_profile(name)
    effective = json.loads(json.dumps(profile.effective(), allow_nan=False))
    again = profile_from_effective(effective, "manifest.json")
    assert again.effective() == profile.effective()
    assert again.source_path is None
    assert effective["control"]["phi_m"] == profile.control.phi_m  # no shipped file states it


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_eds_files_exist(name):
    profile = load_profile(name)
    for axis in profile.axes:
        assert profile.eds_path(axis).is_file()


@pytest.mark.parametrize("name", SHIPPED)
def test_drivers_understand_the_interferometer_table(name):
    table = load_profile(name).effective()["interferometer"]
    framer_for(table)
    assert counts_per_wavelength_of(table)[0] == (8.0 if name == "oled-printer-umd2" else 2048.0)


def test_one_count_of_the_umd2_is_79_nm():
    profile = load_profile("oled-printer-umd2")
    count_m = profile.air.wavelength_vacuum_m / 1.00027137 / profile.interferometer.frame.counts_per_wavelength
    assert count_m == pytest.approx(79.1e-9, abs=0.05e-9)
    assert profile.interferometer.interpolation_speed_m_per_s == 10e-6


def test_single_axis_has_no_micro():
    profile = load_profile("single-axis")
    assert profile.axes == ("macro",)
    assert profile.micro is None
    assert profile.backlash is None
    assert "micro" not in profile.effective()
    with pytest.raises(ProfileError, match="no axis 'micro'"):
        profile.eds_path("micro")


def test_kang_2023_holds_the_paper_set():
    profile = load_profile("kang-2023")
    assert (profile.macro.mass_kg, profile.micro.mass_kg) == (70.0, 40.0)
    assert profile.macro.rated_force_n / profile.macro.rated_current_a == pytest.approx(224.0)
    assert profile.micro.rated_force_n / profile.micro.rated_current_a == pytest.approx(15.6)
    assert (profile.micro.spring_n_per_m, profile.micro.damping_n_s_per_m) == (500.0, 7.6e-5)
    joint = profile.backlash
    assert (joint.left_m, joint.right_m) == (7.5e-3, 7.5e-3)
    assert (joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m) == (1e3, 1e3)
    contact = [effect for effect in profile.effects if effect["acts_on"] == "contact"]
    assert contact == [{"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": 300.0}]


def test_worst_bus_load_of_two_torque_axes():
    # 2 x (RPDO of 4 bytes, 95 bit + TPDO of 8 bytes, 135 bit) + SYNC of 55 bit = 515 bit a millisecond, all stuffed
    assert load_profile("oled-printer").worst_bus_load_ratio == pytest.approx(0.515)


def test_position_mode_is_the_default_and_needs_a_longer_rpdo(bench):
    bench.write_text(changed(OLED, {"macro.mode": ABSENT}))
    profile = load_profile(bench)
    assert profile.macro.mode == "position"
    assert profile.worst_bus_load_ratio == pytest.approx(0.555)  # RPDO of 8 bytes: 135 bit for 95


def test_what_the_motion_asks_of_each_drive():
    """oled-printer: 110 kg and 40 kg at 4 m/s^2, which is more than the ramp's 2 m/s^2."""
    profile = load_profile("oled-printer")
    assert profile.motion_force_n("macro") == 440.0
    assert profile.motion_force_n("micro") == 160.0


def test_a_lower_force_limit_takes_the_thermal_limit_along_and_loads_again():
    profile = load_profile("oled-printer")
    lowered = profile.with_force_limits({"micro": 50.0, "macro": 3000.0})
    assert (lowered.micro.force_limit_n, lowered.micro.thermal_force_n) == (50.0, 50.0)
    assert (lowered.macro, lowered.sha256) == (profile.macro, profile.sha256)
    assert profile_from_effective(lowered.effective(), "the test").effective() == lowered.effective()


def test_a_limp_micro_keeps_off_its_stops_up_to_a_braking_worked_out_by_hand():
    """oled-printer towards its right edge: from 75.3 um beyond the spring's rest 924.7 um to the stop, 824 um of them
    against 9870 N/m: (9870 x 824e-6^2 + 500 x (1e-6 - 75.3e-6^2)) / (2 x 40 x 924.7e-6) = 0.0973; left: 0.1515."""
    assert load_profile("oled-printer").limp_deceleration_m_per_s2 == pytest.approx(0.0973, abs=1e-4)
    assert load_profile("single-axis").limp_deceleration_m_per_s2 is None


def test_profile_is_frozen():
    profile = load_profile("oled-printer")
    with pytest.raises(ValidationError):
        profile.macro.mass_kg = 1.0
    with pytest.raises(ValidationError):
        profile.name = "other"


def test_effects_are_plain_tables_with_floats(bench):
    bench.write_text(changed(OLED, {"effects[0].damping_n_s_per_m": 5}))
    assert load_profile(bench).effects[0] == {
        "name": "viscous_friction",
        "acts_on": "macro_force",
        "damping_n_s_per_m": 5.0,
    }
    assert type(load_profile(bench).effects[0]["damping_n_s_per_m"]) is float


# --- names and folders


def test_own_folder_is_searched_after_the_shipped_one(bench, monkeypatch):
    bench.write_text(changed(OLED, {"name": "bench"}))
    (bench.parent / "oled-printer.toml").write_text(changed(OLED, {"macro.mass_kg": 71.0}))
    with pytest.raises(ProfileError, match="profile 'bench' is not in"):
        load_profile("bench")
    monkeypatch.setenv("STAGECTL_PROFILES", str(bench.parent))
    assert load_profile("bench").name == "bench"
    assert load_profile("oled-printer").macro.mass_kg == 70.0
    assert "bench" in list_profiles()


def test_unknown_name_suggests_the_closest():
    with pytest.raises(ProfileError, match="did you mean oled-printer\\?"):
        load_profile("oled-primter")


def test_eds_beside_the_profile_comes_first(bench):
    bench.write_text(changed(OLED, {}))
    own = bench.parent / "stagectl-voice-coil.eds"
    own.write_text("[FileInfo]\n")
    assert load_profile(bench).eds_path("micro") == own
    assert load_profile(bench).eds_path("macro") == PROFILES_FOLDER / "stagectl-linear-motor.eds"


# --- bad numbers, anywhere


BAD_NUMBERS = st.sampled_from([math.nan, -math.nan, math.inf, -math.inf, True, False, "70", "70 kg", "nan", "", [], {}])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(leaf=st.sampled_from(LEAVES), bad=BAD_NUMBERS)
def test_bad_number_in_any_shipped_profile_is_refused_by_name(leaf, bad, tmp_path):
    name, location = leaf
    text = refusal(tmp_path / "bad.toml", changed(PROFILES_FOLDER / f"{name}.toml", {dotted(location): bad}))
    lines = [line for line in text.splitlines() if f"bad.toml: {dotted(location)} = " in line]
    assert len(lines) == 1, text
    assert "; " in lines[0]


@pytest.mark.parametrize(
    ("name", "location"), LEAVES, ids=lambda value: value if isinstance(value, str) else dotted(value)
)
def test_nan_in_every_number_of_every_shipped_profile_is_refused(name, location, tmp_path):
    text = refusal(tmp_path / "bad.toml", changed(PROFILES_FOLDER / f"{name}.toml", {dotted(location): math.nan}))
    assert f"{dotted(location)} = nan: must be" in text


def tables_below(model: type[BaseModel]) -> set[type[BaseModel]]:
    """Return a model and every table class below it."""

    def inside(annotation: Any) -> set[type[BaseModel]]:
        if isinstance(annotation, type) and not get_args(annotation) and issubclass(annotation, BaseModel):
            return tables_below(annotation)
        return {found for argument in get_args(annotation) for found in inside(argument)}

    below = {found for field in model.model_fields.values() for found in inside(field.annotation)}
    return {model} | below


def unbounded_numbers(annotation: Any, metadata: list[Any]) -> bool:
    """Return whether an annotation allows a number without bounds."""
    if any(isinstance(item, Within) for item in metadata):
        return False
    origin = get_origin(annotation)
    if origin is Annotated:
        inner, *more = get_args(annotation)
        return unbounded_numbers(inner, more)
    if origin is Literal:
        return False
    if origin in (tuple, Union, types.UnionType):
        return any(unbounded_numbers(argument, []) for argument in get_args(annotation) if argument is not Ellipsis)
    return annotation in (int, float)


@pytest.mark.parametrize("model", [Profile, Machine])
def test_every_number_has_bounds(model):
    loose = [
        f"{table.__name__}.{key}"
        for table in tables_below(model)
        for key, field in table.model_fields.items()
        if unbounded_numbers(field.annotation, field.metadata)
    ]
    assert loose == []


@pytest.mark.parametrize("model", [Profile, Machine])
def test_every_float_states_its_unit(model):
    def is_float(annotation: Any) -> bool:
        return annotation is float or any(is_float(argument) for argument in get_args(annotation))

    nameless = {
        key
        for table in tables_below(model)
        for key, field in table.model_fields.items()
        if is_float(field.annotation) and unit_of(key) is None
    }
    assert nameless <= {"counts_per_wavelength"}  # counts over a length that is a constant of nature


# --- bad input, word by word


def test_travel_reversed(bench):
    text = refusal(bench, changed(OLED, {"macro.travel_m": [0.4, -0.4]}))
    assert text == "profiles/bench.toml: macro.travel_m = [0.4, -0.4]: lower end must be below the upper; swap them"


def test_unknown_key_suggests_the_closest(bench):
    text = refusal(bench, changed(OLED, {"macro.travell_m": [0.0, 1.0]}))
    assert (
        text
        == "profiles/bench.toml: macro.travell_m = [0.0, 1.0]: is not a key of this table; did you mean travel_m (m)?"
    )


def test_unknown_table(bench):
    text = refusal(bench, changed(OLED, {"interferometre": {"noise_m": 1e-9}}))
    assert "interferometre = { noise_m = 1e-09 }: is not a key of this table; did you mean interferometer?" in text


@pytest.mark.parametrize("given_key", ["mass", "mass_g", "mass_lb"])
def test_wrong_or_missing_unit_says_the_expected_one(bench, given_key):
    text = refusal(bench, changed(OLED, {"macro.mass_kg": ABSENT, f"macro.{given_key}": 70}))
    assert text == (
        f"profiles/bench.toml: macro.{given_key} = 70: the name must end in its unit, kg; write mass_kg, in kg"
    )


@pytest.mark.parametrize(
    ("key", "good", "unit"),
    [
        ("macro.travel_mm", "travel_m", "m"),
        ("macro.acceleration_limit_mm_per_s2", "acceleration_limit_m_per_s2", "m/s^2"),
        ("backlash.left_stiffness_n_per_mm", "left_stiffness_n_per_m", "N/m"),
        ("cycle.rate_khz", "rate_hz", "Hz"),
        ("air.temperature_k", "temperature_degc", "degC"),
        ("air.pressure_hpa", "pressure_pa", "Pa"),
        ("trip.sensor_age_ms", "sensor_age_s", "s"),
        ("effects[0].damping", "damping_n_s_per_m", "N s/m"),
    ],
)
def test_other_units_say_the_expected_one(bench, key, good, unit):
    parent = key.rpartition(".")[0]
    text = refusal(bench, changed(OLED, {f"{parent}.{good}": ABSENT, key: 20.0}))
    assert text == (
        f"profiles/bench.toml: {key} = 20.0: the name must end in its unit, {unit}; write {good}, in {unit}"
    )


def test_nan_says_so(bench):
    text = refusal(bench, changed(OLED, {"micro.mass_kg": math.nan}))
    assert text == "profiles/bench.toml: micro.mass_kg = nan: must be a finite number; write the true value, in kg"


def test_text_for_a_number(bench):
    text = refusal(bench, changed(OLED, {"micro.mass_kg": "40"}))
    assert text == (
        'profiles/bench.toml: micro.mass_kg = "40": must be a number, not text; write it without quotes, in kg'
    )


def test_out_of_range_says_the_limit(bench):
    text = refusal(bench, changed(OLED, {"air.relative_humidity_percent": 130.0}))
    assert text == ("profiles/bench.toml: air.relative_humidity_percent = 130.0: must be 0 to 100 %; correct it, in %")


def test_missing_key_says_its_unit(bench):
    text = refusal(bench, changed(OLED, {"macro.rated_current_a": ABSENT}))
    assert text == "profiles/bench.toml: macro.rated_current_a is missing; add it, in A"


def test_missing_table(bench):
    text = refusal(bench, changed(OLED, {"air": ABSENT}))
    assert text == "profiles/bench.toml: air is missing; add it"


def test_node_ids_equal(bench):
    text = refusal(bench, changed(OLED, {"micro.node_id": 1}))
    assert text == (
        "profiles/bench.toml: micro.node_id = 1: is macro.node_id as well, and a CANopen node id belongs to one drive;"
        " give each drive its own"
    )


def test_node_id_of_the_servo_is_taken(bench):
    assert "micro.node_id = 126: must be 1 to 125" in refusal(bench, changed(OLED, {"micro.node_id": 126}))


def test_eds_missing(bench):
    text = refusal(bench, changed(OLED, {"macro.eds": "nowhere.eds"}))
    assert text.startswith('profiles/bench.toml: macro.eds = "nowhere.eds": there is no such file in ')
    assert str(bench.parent) in text
    assert text.endswith("; put the drive's EDS beside the profile, or correct the name")


def test_several_problems_are_all_listed(bench):
    changes = {
        "macro.travel_m": [0.4, -0.4],
        "macro.mass_kg": ABSENT,
        "macro.mass": 70,
        "micro.stroke_m": [0.001, -0.001],
        "cycle.rate_hz": math.nan,
        "effects[1].fraction_ratio": 2.0,
        "interferometer.frame.fields[0].type": "u33",
        "can.interface": "vcan",
    }
    lines = refusal(bench, changed(OLED, changes)).splitlines()
    assert all(line.startswith("profiles/bench.toml: ") for line in lines)
    keys = sorted(line.split(": ")[1].split(" = ")[0] for line in lines)
    assert keys == sorted(
        [
            "can.interface",
            "cycle.rate_hz",
            "effects[1].fraction_ratio",
            "interferometer.frame.fields[0].type",
            "macro.mass",
            "micro.stroke_m",
        ]
    )


def test_contradictions_of_one_table_are_all_listed(bench):
    changes = {"macro.travel_m": [0.4, -0.4], "macro.thermal_force_n": 3000.0, "macro.mass_sd_kg": 80.0}
    lines = refusal(bench, changed(OLED, changes)).splitlines()
    assert [line.split(": ")[1].split(" = ")[0] for line in lines] == [
        "macro.thermal_force_n",
        "macro.mass_sd_kg",
        "macro.travel_m",
    ]


CONTRADICTIONS = [
    ({"macro.force_limit_n": 16384.0}, "macro.force_limit_n", "ends at 16383.5 N"),
    ({"macro.thermal_force_n": 2500.0}, "macro.thermal_force_n", "above force_limit_n = 2000"),
    (
        {"macro.velocity_limit_m_per_s": 1.95},
        "macro.velocity_limit_m_per_s",
        "takes 0.950625 m, the whole travel is 0.9",
    ),
    ({"macro.homing.speed_m_per_s": 0.6}, "macro.homing.speed_m_per_s", "above velocity_limit_m_per_s = 0.5"),
    ({"macro.acceleration_limit_m_per_s2": 20.0}, "macro.acceleration_limit_m_per_s2", "110 kg so takes 2200 N"),
    ({"macro.travel_m": [0.1, 0.45]}, "macro.travel_m", "must hold 0, the index of the encoder, where homing ends"),
    ({"macro.travel_m": [0.0, 0.45]}, "macro.travel_m", "must hold 0"),
    ({"micro.stop": "ramp"}, "micro.stop", "without an encoder can't ramp"),
    ({"micro.stroke_m": [0.0001, 0.001]}, "micro.stroke_m", "must hold 0"),
    # right edge: 176 um + 4 N / 9.87 N/mm = 581 um to reach
    ({"micro.stroke_m": [-0.00058, 0.001]}, "micro.stroke_m", "from below -0.000581268 to above 0.00032843"),
    ({"backlash.left_m": 0.0009}, "micro.stroke_m", "must reach from below"),
    ({"backlash.left_m": 0.0, "backlash.right_m": 0.0}, "backlash.right_m", "must be above 0"),
    ({"backlash.touch_force_n": 6.0}, "backlash.touch_force_n", "must be above 0 and at most 5 N"),
    ({"backlash": ABSENT}, "backlash", "is missing: [micro] and [backlash] belong together"),
    (
        {"cycle.phase_s": 0.001, "cycle.actuation_delay_s": 0.0012},
        "cycle.phase_s",
        "must be below one period (0.001 s)",
    ),
    ({"cycle.phase_s": 0.0006}, "cycle.actuation_delay_s", "the force acts after the cycle starts"),
    ({"cycle.actuation_delay_s": 0.0014}, "cycle.actuation_delay_s", "within one period (0.001 s)"),
    ({"cycle.phase_s": 0.0001}, "cycle.phase_s", "no line is in before interferometer.transport_s = 0.00015"),
    ({"trip.sensor_age_s": 0.004}, "trip.sensor_age_s", "must be above 0.004 s"),
    ({"trip.rpdo_deadline_s": 0.0015}, "trip.rpdo_deadline_s", "at least two cycles (0.002 s)"),
    ({"can.bitrate_bit_per_s": 500e3}, "cycle.rate_hz", "may take 103% of 500000 bit/s"),
    ({"interferometer.rate_hz": 1500.0}, "interferometer.rate_hz", "a whole multiple"),
    ({"interferometer.jump_limit_m": 0.0005}, "interferometer.jump_limit_m", "moves 0.0005 m in a sample"),
    ({"interferometer.baud_bit_per_s": 230400.0}, "interferometer.baud_bit_per_s", "take 250000 bit/s"),
    ({"interferometer.format": "sincfixed"}, "interferometer.format", "must be one of 'syncfixed'"),
    ({"interferometer.format": ABSENT}, "interferometer.format", "is missing"),
    ({"interferometer.frame": ABSENT}, "interferometer.frame", "is missing"),
    ({"interferometer.frame.sync": "a55"}, "interferometer.frame.sync", "must look like"),
    (
        {"interferometer.frame.length": 24},
        "interferometer.frame.fields[3].offset",
        "length = 24 with its checksum leaves 22",
    ),
    (
        {"interferometer.frame.fields[2].offset": 12},
        "interferometer.frame.fields[2].offset",
        "end shares bytes with macro",
    ),
    ({"interferometer.frame.fields[0].offset": 1}, "interferometer.frame.fields[0].offset", "shares bytes with sync"),
    (
        {"interferometer.frame.fields[3].valid_value": 4},
        "interferometer.frame.fields[3].valid_value",
        "outside the masks",
    ),
    (
        {"interferometer.frame.fields[3].macro_mask": ABSENT, "interferometer.frame.fields[3].end_mask": ABSENT},
        "interferometer.frame.fields[3].valid_mask",
        "is missing",
    ),
    (
        {"interferometer.frame.fields[1].counts_per_wavelength": ABSENT},
        "interferometer.frame.fields[1].counts_per_wavelength",
        "is missing",
    ),
    ({"interferometer.frame.fields[0].valid_mask": 1}, "interferometer.frame.fields[0].valid_mask", "role status only"),
    (
        {"interferometer.frame.fields[2].role": "macro"},
        "interferometer.frame.fields[2].role",
        "the role of macro already",
    ),
    ({"interferometer.frame.fields[0].role": "ignore"}, "interferometer.frame.fields", "none has the role sequence"),
    ({"control.park_error_m": 300e-6}, "control.park_error_m", "above control.error_limit_m = 0.0002"),
    ({"control.macro_bandwidth_hz": 250.0}, "control.macro_bandwidth_hz", "a fifth of cycle.rate_hz, 200 Hz"),
    ({"control.gamma_ratio": 0.25, "control.eta_ratio": 0.99}, "control.eta_ratio", "at least 2 sqrt(gamma_ratio) = 1"),
    ({"control.law": "pd"}, "control.law", "must be 'dsmc' or 'pid'"),
    ({"effects[0].name": "viscous_fricton"}, "effects[0].name", "did you mean viscous_friction?"),
    ({"effects[0].name": ABSENT}, "effects[0].name", "is missing"),
    ({"effects[0].acts_on": "contact"}, "effects[0].acts_on", "may act on macro_force or micro_force only"),
    ({"effects[0].damping_n_s_per_m": ABSENT}, "effects[0].damping_n_s_per_m", "is missing; add it, in N s/m"),
    ({"effects[0].damping_n_s_per_m": -1.0}, "effects[0].damping_n_s_per_m", "must be 0 to 100000 N s/m"),
    ({"effects[0].level_n": 1.0}, "effects[0].level_n", "is not a key of this table"),
    ({"effects[0].damping_n_s_per_m": 10**400}, "effects[0].damping_n_s_per_m", "must be 0 to 100000 N s/m"),
    ({"macro.encoder_step_m": 10**400}, "macro.encoder_step_m", "a number of 1329 bits"),
    ({"macro.mass_kg": 0.0}, "macro.mass_kg", "must be above 0 and at most 100000 kg"),
    ({"macro.mass_kg": -70}, "macro.mass_kg", "must be above 0 and at most 100000 kg"),
    ({"macro.node_id": 1.0}, "macro.node_id", "must be a whole number"),
    ({"macro.travel_m": [-0.4, 0.0, 0.4]}, "macro.travel_m", "at most 2 elements"),
    ({"macro.travel_m": [0.4]}, "macro.travel_m[1]", "is missing"),
    ({"macro.travel_m": 0.4}, "macro.travel_m", "must be a list"),
    ({"macro.homing": 34}, "macro.homing", "must be a table"),
    ({"interferometer.incremental": "yes"}, "interferometer.incremental", "must be true or false"),
    ({"interferometer.incremental": 1}, "interferometer.incremental", "must be true or false"),
    ({"macro.eds": 3}, "macro.eds", "must be text"),
    ({"name": "Bench 1"}, "name", "must look like"),
    ({"can.channel": "can\0"}, "can.channel", "must look like"),
    ({"interferometer.port": "/dev/\0"}, "interferometer.port", "must look like"),
    ({"interferometer.port": "/dev/\x1b[2J"}, "interferometer.port", "must look like"),
]


@pytest.mark.parametrize(
    ("changes", "key", "limit"), CONTRADICTIONS, ids=lambda value: value if isinstance(value, str) else ""
)
def test_contradiction_is_refused(bench, changes, key, limit):
    lines = refusal(bench, changed(OLED, changes)).splitlines()
    assert [line for line in lines if line.startswith(f"profiles/bench.toml: {key} ") and limit in line], lines
    assert len(lines) == 1, lines
    assert "; " in lines[0]


def test_single_axis_refuses_what_needs_a_micro(bench):
    single = PROFILES_FOLDER / "single-axis.toml"
    effects = [
        {"name": "micro_reaction", "acts_on": "macro_force", "fraction_ratio": 1.0},
        {"name": "viscous_friction", "acts_on": "micro_force", "damping_n_s_per_m": 1.0},
        {"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": 1.0},
    ]
    effects += [
        {"name": "linear_stiffness", "acts_on": "joint", "stiffness_n_per_m": 1.0},
        {"name": "backlash_wear", "acts_on": "contact_edge", "rate_m_per_s": 1e-9},
        {"name": "amplifier_dead_band", "acts_on": "micro_command", "half_width_a": 0.01},
        {"name": "scale_error", "acts_on": "end_sensor", "error_ppm": 1.0},
    ]
    lines = refusal(bench, changed(single, {"effects": effects})).splitlines()
    assert [line.split(": ")[1].split(" = ")[0] for line in lines] == [f"effects[{n}].name" for n in range(7)]
    fields = tomllib.loads(OLED.read_text())["interferometer"]["frame"]["fields"]
    text = refusal(bench, changed(single, {"interferometer.frame.fields": fields}))
    assert "the stream carries an end, and there is no [micro]" in text


def test_stage_with_a_micro_needs_its_position(bench):
    fields = tomllib.loads((PROFILES_FOLDER / "single-axis.toml").read_text())["interferometer"]["frame"]["fields"]
    text = refusal(bench, changed(OLED, {"interferometer.frame.fields": fields}))
    assert "the stream carries no position of the end" in text


UMD2 = PROFILES_FOLDER / "oled-printer-umd2.toml"


@pytest.mark.parametrize(
    ("changes", "key", "limit"),
    [
        ({"interferometer.frame.columns_count": 8}, "interferometer.frame.end_axis", "8 columns carries axis 1 only"),
        ({"interferometer.frame.columns_count": 12}, "interferometer.frame.columns_count", "must be 8 or 16"),
        ({"interferometer.frame.end_axis": 1}, "interferometer.frame.end_axis", "is macro_axis as well"),
        ({"interferometer.frame.end_axis": 0}, "interferometer.format", "carries no position of the end"),
        ({"interferometer.frame.sync": "a55a"}, "interferometer.frame.sync", "is not a key of this table"),
        ({"interferometer.interpolation_speed_mm_per_s": 1.0}, "interferometer.interpolation_speed_mm_per_s", "m/s"),
    ],
)
def test_umd2_contradiction_is_refused(bench, changes, key, limit):
    (line,) = refusal(bench, changed(UMD2, changes)).splitlines()
    assert line.startswith(f"profiles/bench.toml: {key} = ")
    assert limit in line


def test_unknown_key_is_compared_with_the_keys_of_its_format_only(bench):
    text = refusal(bench, changed(UMD2, {"interferometer.frame.sync": "a55a"}))
    assert text.endswith(
        "remove it, or choose from columns_count, macro_axis, end_axis, phase_bits, homodyne, velocity_check,"
        " counts_per_wavelength"
    )


def sensor(form: str, frame: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return changes that give the shipped profile another interferometer."""
    changes = {"interferometer.format": form, "interferometer.frame": frame}
    return changes | {f"interferometer.{key}": value for key, value in more.items()}


POSITIONS = [
    {"name": "sequence", "index": 0, "role": "sequence", "modulus": 65536},
    {"name": "macro", "index": 1, "role": "macro", "counts_per_wavelength": 8.0},
    {"name": "end", "index": 2, "role": "end", "counts_per_wavelength": 8.0, "invalid_from": 262073},
]
OTHER_SENSORS = {
    "line": sensor("line", {"columns_count": 3, "fields": POSITIONS, "separator": ","}),
    "flagbits": sensor("flagbits", {"values_count": 3, "fields": POSITIONS}),
    "micro-epsilon": sensor("micro-epsilon", {"values": ["macro", "end", "counter"], "counts_per_wavelength": 41.4}),
}


@pytest.mark.parametrize("form", OTHER_SENSORS)
def test_other_formats_load_and_drivers_understand_them(bench, form):
    bench.write_text(changed(OLED, OTHER_SENSORS[form]))
    table = load_profile(bench).effective()["interferometer"]
    assert table["incremental"] is True  # as the file says; absolute gauges default to false
    framer_for(table)
    assert counts_per_wavelength_of(table)[1] == (41.4 if form == "micro-epsilon" else 8.0)


@pytest.mark.parametrize(
    ("form", "changes", "key", "limit"),
    [
        ("line", {"columns_count": 2}, "fields[2].index", "must be below columns_count = 2"),
        ("line", {"separator": "\r\n"}, "delimiter", "is the separator as well"),
        ("flagbits", {"values_count": 2}, "fields[2].index", "must be below values_count = 2"),
        ("flagbits", {"more_tag": 2}, "tags", "must be like no other"),
        ("flagbits", {"tags": [0, 1, 4]}, "tags", "must be at most 3 with tag_bits = 2"),
        ("micro-epsilon", {"values": ["macro", "end"]}, "values", "must name counter once"),
        ("micro-epsilon", {"values": ["macro", "end", "end", "counter"]}, "values", "must name end at most once"),
        ("micro-epsilon", {"values": ["macro", "end", "count"]}, "values[2]", "must be 'macro', 'end', 'counter' or"),
    ],
)
def test_other_formats_refuse_contradictions(bench, form, changes, key, limit):
    below = {f"interferometer.frame.{name}": value for name, value in changes.items()}
    (line,) = refusal(bench, changed(OLED, OTHER_SENSORS[form] | below)).splitlines()
    assert line.startswith(f"profiles/bench.toml: interferometer.frame.{key} = ")
    assert limit in line


def test_keys_and_values_with_control_characters_stay_on_one_line(bench):
    text = refusal(bench, changed(OLED, {}) + '"a\\u001b\\r\\nb" = "c\\u001b\\r\\nd"\n')
    assert text.splitlines() == [text]
    assert "\x1b" not in text


# --- files that are no TOML


def test_not_toml_says_where(bench):
    text = refusal(bench, 'name = "bench"\nname = "again"\n')
    assert text.startswith("profiles/bench.toml: is not TOML: Cannot overwrite a value (at line 2, ")


def test_not_text(bench):
    bench.write_bytes(b'name = "\xff"\n')
    with pytest.raises(ProfileError, match="is not UTF-8 text"):
        load_profile(bench)


def test_nested_too_deeply(bench):
    assert "is nested too deeply" in refusal(bench, "name = " + "[" * 5000 + "]" * 5000 + "\n")


def test_number_with_too_many_digits(bench):
    assert "is not TOML" in refusal(bench, "name = " + "9" * 5000 + "\n")


def test_absent_file_and_folder(bench):
    with pytest.raises(ProfileError, match=r"profiles/bench\.toml: can't be read \(No such file or directory\)"):
        load_profile(bench)
    with pytest.raises(ProfileError, match="Is a directory"):
        load_profile(bench.parent)


def test_empty_file_lists_every_table(bench):
    lines = refusal(bench, "").splitlines()
    tables = ["name", "cycle", "trip", "can", "macro", "interferometer", "air", "control"]
    assert lines == [f"profiles/bench.toml: {table} is missing; add it" for table in tables]


def test_hand_written_toml_of_the_tests_is_what_it_says():
    value = {"a": [1, -2.5e-9, True, 'x"\r\n'], "b": {"c": math.inf}}
    assert tomllib.loads(f"value = {toml_of(value)}") == {"value": value}
    assert location_of("effects[0].name") == ("effects", 0, "name")
