"""What the gap workflow takes for noise: force noise of all recordings, and recordings that were filtered."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from stagectl.gap import balance, plausibility
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.competition import Competition
from stagectl.gap.log import Log
from stagectl.gap.noise import is_low_passed, noise_of
from stagectl.gap.recording import Recording

H, MASS_KG, NOISE_M, FORCE_NOISE_N = 1e-3, 95.0, 15e-9, 1.0
COUNT = 12_000
AXIS = Believed("axis", H, BelievedAxis(MASS_KG, 0.4, NOISE_M, 0.0))


def _log(name: str, seed: int, force_noise_n: float = FORCE_NOISE_N, sensor_noise_m: float = NOISE_M) -> Log:
    """Swing by 20 mm under a held command and a force that is independent from sample to sample: in closed form."""
    random = np.random.default_rng(seed)
    w = 2.0 * np.pi * 1.3
    command_n = -MASS_KG * w * w * 0.02 * np.sin(w * H * np.arange(COUNT))
    force_n = command_n + force_noise_n * random.standard_normal(COUNT)
    speed = 0.02 * w + np.concatenate([[0.0], np.cumsum(force_n)[:-1]]) * H / MASS_KG
    moved_m = speed * H + 0.5 * force_n * H * H / MASS_KG
    position_m = np.concatenate([[0.0], np.cumsum(moved_m)[:-1]]) + sensor_noise_m * random.standard_normal(COUNT)
    return Log(name, H, position_m, command_n, np.ones(COUNT, bool), name)


def _low_passed(log: Log, corner_hz: float = 250.0) -> Log:
    sos = butter(3, corner_hz * 2.0 * H, output="sos")
    return dataclasses.replace(log, macro_position_m=sosfiltfilt(sos, log.macro_position_m))


def _recording(log: Log) -> Recording:
    return balance.recording_of(log, AXIS)


@pytest.mark.parametrize("force_noise_n", [0.0, FORCE_NOISE_N, 20.0])
def test_recording_that_was_low_passed_is_told_from_one_as_it_was_read(force_noise_n):
    read = _log("read", 3, force_noise_n)
    assert not is_low_passed(_recording(read), "macro")
    assert is_low_passed(_recording(_low_passed(read)), "macro")


def test_sensor_that_is_better_than_stated_is_not_taken_for_a_filter():
    assert not is_low_passed(_recording(_log("quiet", 4, 0.0, NOISE_M / 10.0)), "macro")


def test_force_noise_is_read_where_the_sensor_has_its_noise():
    """It comes in steps of two. Of both together eight times as much was taken."""
    read, stored = _recording(_log("read", 5)), _recording(_low_passed(_log("stored", 6)))
    assert 0.5 * FORCE_NOISE_N < noise_of([read, stored])["macro"].white_force_n < 2.0 * FORCE_NOISE_N
    assert 0.5 * FORCE_NOISE_N < noise_of([stored])["macro"].white_force_n < 2.0 * FORCE_NOISE_N


def test_sensor_that_is_louder_in_the_middle_of_its_band_makes_no_force_noise():
    """A force would show most at lower frequencies. 16 mN were taken for one, above which a flexible mode was named."""
    random, log = np.random.default_rng(11), _log("louder", 11, 0.0)
    sos = butter(2, np.array([60.0, 200.0]) * 2.0 * H, btype="band", output="sos")
    louder_m = 0.45 * NOISE_M * sosfiltfilt(sos, random.standard_normal(COUNT))
    louder = dataclasses.replace(log, macro_position_m=log.macro_position_m + louder_m)
    assert noise_of([_recording(louder)])["macro"].white_force_n == 0.0


def test_filtered_recording_counts_no_more_than_one_as_it_was_read():
    """Its innovations at high frequencies, where noise is read of others, are next to nothing."""
    read, stored = _recording(_log("read", 7)), _recording(_low_passed(_log("stored", 8)))
    search = Competition([read, stored], 2, noise=noise_of([read, stored]))
    (of_read,), (of_stored,) = search.evidence.scales
    assert of_stored == pytest.approx(of_read, rel=0.1)


def test_report_says_what_was_filtered():
    read, stored = _recording(_log("read", 9)), _recording(_low_passed(_log("stored", 10)))
    (remark,) = plausibility.check_recordings(AXIS, [read, stored])
    assert remark.startswith("stored: positions of the macro were low-passed before they were stored")
