"""Figures for Prometheus that are worked out here: of cycles, samples, faults, the bus, and of the joint."""

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from stagectl.row import new_rows
from stagectl.service import messages
from stagectl.service.exposition import Figures
from tests.service.test_stage_loop import Bench


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


def scraped(figures):
    """What a scraper finds: values by name and, where there is one, label."""
    families = text_string_to_metric_families(figures.exposition(STATUS).decode())
    samples = [sample for family in families for sample in family.samples]
    return {(one.name, *one.labels.values()): one.value for one in samples}


def buckets(found, name):
    """The counts of a histogram by their bounds in seconds."""
    return {float(key[1]): value for key, value in found.items() if key[0] == f"{name}_bucket"}


def cycles_of(lateness_ns, age_ns, missed, lost, refused):
    """Rows of one servo, from its first."""
    rows = rows_from(1000, len(lateness_ns))
    rows["lateness_ns"] = lateness_ns
    rows["sample_t_ns"] = [0 if age is None else t_ns - age for t_ns, age in zip(rows["t_ns"], age_ns, strict=True)]
    rows["cycles_missed"], rows["samples_lost"], rows["command_lost"] = missed, lost, refused
    return rows


FIRST = cycles_of(
    lateness_ns=[-5_000, 15_000, 20_000, 150_000, 3_000_000, 60_000_000],
    age_ns=[None, None, 250_000, 450_000, 800_000, 60_000_000],
    missed=[0, 0, 0, 1, 1, 3],
    lost=[0, 2, 2, 2, 7, 7],
    refused=[0, 0, 1, 1, 0, 0],
)
SECOND = cycles_of(
    lateness_ns=[1_000, 1_500_000, 1_000], age_ns=[250_000] * 3, missed=[0, 2, 2], lost=[1, 1, 1], refused=[0, 0, 1]
)


def test_cycles_and_samples_are_counted_over_all_servos(oled_profile):
    """Those in the rows begin at 0 with each servo; a counter that falls says that the service began anew."""
    figures, names = Figures(), ("cycles", "cycles_missed", "samples_lost", "commands_refused")

    def counts():
        found = scraped(figures)
        return tuple(found[f"stagectl_{name}_total",] for name in names)

    assert counts() == (0, 0, 0, 0)
    figures.begin_servo(oled_profile)
    seen = []
    for rows in (FIRST[:1], FIRST[1:4], FIRST[4:4], FIRST[4:]):
        figures.add(rows)
        seen.append(counts())
    assert seen == [(1, 0, 0, 0), (4, 1, 2, 2), (4, 1, 2, 2), (6, 3, 7, 2)]
    figures.begin_servo()
    assert counts() == seen[-1]
    figures.begin_servo(oled_profile)
    assert counts() == seen[-1]
    figures.add(SECOND[:1])
    assert counts() == (7, 3, 8, 2)
    figures.add(SECOND[1:])
    assert counts() == (9, 5, 8, 3)


def test_lateness_and_age_of_samples_are_histograms_over_all_servos(oled_profile):
    figures = Figures()
    for rows in (FIRST, SECOND):
        figures.begin_servo(oled_profile)
        figures.add(rows)
    found = scraped(figures)
    late = {1e-5: 3, 2e-5: 5, 5e-5: 5, 1e-4: 5, 2e-4: 6, 5e-4: 6, 1e-3: 6, 2e-3: 7, 5e-3: 8, 1e-2: 8, 2e-2: 8, 5e-2: 8}
    assert buckets(found, "stagectl_cycle_lateness_seconds") == late | {np.inf: 9}
    assert found["stagectl_cycle_lateness_seconds_count",] == 9
    on_time_is_zero_s = 15e-6 + 20e-6 + 150e-6 + 3e-3 + 60e-3 + 1e-6 + 1.5e-3 + 1e-6
    assert found["stagectl_cycle_lateness_seconds_sum",] == pytest.approx(on_time_is_zero_s, rel=1e-9)
    old = {2e-4: 0, 3e-4: 4, 4e-4: 4, 5e-4: 5, 7e-4: 5, 1e-3: 6, 2e-3: 6, 3e-3: 6, 5e-3: 6, 1e-2: 6, 2e-2: 6, 5e-2: 6}
    assert buckets(found, "stagectl_sample_age_seconds") == old | {np.inf: 7}
    of_known_s = 4 * 250e-6 + 450e-6 + 800e-6 + 60e-3
    assert found["stagectl_sample_age_seconds_sum",] == pytest.approx(of_known_s, rel=1e-9)


def test_faults_are_counted_by_kind():
    figures = Figures()
    assert "stagectl_faults_total" not in {name for name, *_ in scraped(figures)}
    for kind in ("LEASE", "EMERGENCY", "LEASE"):
        figures.fault(kind)
    found = scraped(figures)
    assert {key[1]: value for key, value in found.items() if key[0] == "stagectl_faults_total"} == {
        "LEASE": 2,
        "EMERGENCY": 1,
    }


def test_what_a_servo_missed_is_counted_once_where_its_stage_is_let_go_of(tmp_path):
    """Its last rows come while it is closed."""
    bench = Bench(tmp_path)
    bench.until(lambda: bench.loop._state == "idle")
    observe = bench.loop._stage._observe

    def behind(rows):
        rows = rows.copy()
        rows["cycles_missed"], rows["samples_lost"] = 3, 7
        observe(rows)

    bench.loop._stage._observe = behind
    bench.loop.step()
    bench.loop.step()
    before = scraped(bench.figures)
    assert (before["stagectl_cycles_missed_total",], before["stagectl_samples_lost_total",]) == (3, 7)
    bench.loop.leave()
    bench.loop.run()
    after = scraped(bench.figures)
    assert after["stagectl_cycles_total",] > before["stagectl_cycles_total",]
    assert (after["stagectl_cycles_missed_total",], after["stagectl_samples_lost_total",]) == (3, 7)
    assert bench.figures.recent_lateness_s() is None
