"""Figures for Prometheus that are worked out here: the load of the bus, and what is known of the joint."""

import numpy as np
import pytest

from stagectl.row import new_rows
from stagectl.service import messages
from stagectl.service.exposition import Figures


def rows_from(first, count, every_ns=1_000_000, answers=True):
    rows = new_rows(count)
    rows["t_ns"] = (first + np.arange(count)) * every_ns
    for axis in ("macro", "micro"):
        rows[f"{axis}_tpdo_count"] = 8 if answers else -1
    return rows


def load(figures):
    return next((f.samples[0].value for f in figures.families(STATUS) if f.name == "stagectl_can_load_ratio"), None)


WEAR = messages.Wear(
    left_m=2e-4,
    right_m=3e-4,
    left_stiffness_n_per_m=1e4,
    right_stiffness_n_per_m=1.1e4,
    left_stiffness_sd_n_per_m=None,
    right_stiffness_sd_n_per_m=None,
    width_m=5e-4,
    width_sd_m=1e-7,
    at="",
    age_s=77.0,
    source="production",
    observable=True,
    text="",
    alarm="worn",
    believed_since="",
)
STATUS = messages.Status.model_construct(
    state="idle",
    backend="rig",
    homed=False,
    uptime_s=1.0,
    backlash=None,
    wear=WEAR,
    positions=messages.Positions.model_construct(sample_age_s=0.25),
)


def test_the_bus_s_load_is_what_the_profile_reckons_with_and_less_where_a_drive_is_silent(oled_profile):
    figures = Figures()
    figures.begin_servo(oled_profile)
    assert load(figures) is None
    for first in range(0, 100, 20):
        figures.add(rows_from(first, 20))
    assert load(figures) == pytest.approx(oled_profile.worst_bus_load_ratio, rel=1e-9)
    silent = Figures()
    silent.begin_servo(oled_profile)
    for first in range(0, 100, 20):
        silent.add(rows_from(first, 20, answers=False))
    assert load(silent) == pytest.approx(oled_profile.command_frames_bits * 1e3 / 1e6)
    assert load(silent) < 0.6 * load(figures)


def test_a_servo_that_is_gone_has_no_lateness_and_no_load(oled_profile):
    figures = Figures()
    figures.begin_servo(oled_profile)
    for first in range(0, 100, 20):
        figures.add(rows_from(first, 20))
    assert figures.recent_lateness_s() is not None
    figures.begin_servo()
    assert (figures.recent_lateness_s(), load(figures)) == (None, None)
    figures.add(rows_from(0, 20))
    assert figures.recent_lateness_s() is not None
    assert "stagectl_newest_sample_age_seconds 0.25" in figures.exposition(STATUS).decode()


def test_wear_is_exposed_with_age_and_alarm():
    text = Figures().exposition(STATUS).decode()
    for line in (
        "stagectl_backlash_width_meters 0.0005",
        "stagectl_backlash_width_sd_meters 1e-07",
        "stagectl_backlash_right_stiffness_newtons_per_meter 11000.0",
        "stagectl_backlash_age_seconds 77.0",
        "stagectl_backlash_observable 1.0",
        "stagectl_backlash_wear_alarm 1.0",
    ):
        assert line in text.splitlines()


def test_temperatures_are_exposed_by_axis_and_left_out_where_none_is_known():
    known = {
        "macro": messages.Temperature(degc=41.5, warning=False, age_s=1.0),
        "micro": messages.Temperature(degc=93.0, warning=True, age_s=2.0),
    }
    lines = Figures().exposition(STATUS.model_copy(update={"temperatures": known})).decode().splitlines()
    for line in (
        'stagectl_drive_temperature_celsius{axis="macro"} 41.5',
        'stagectl_drive_temperature_celsius{axis="micro"} 93.0',
        'stagectl_drive_temperature_warning{axis="macro"} 0.0',
        'stagectl_drive_temperature_warning{axis="micro"} 1.0',
    ):
        assert line in lines
    assert "temperature" not in Figures().exposition(STATUS).decode()
