"""An interferometer that repeats its counts while the stage holds: told by the noise that is missing."""

import pytest

from sim_backend.faults import Fault
from tests.service.test_stage_loop import Bench

STUCK_S = 0.2
WATCHED_S = 0.5


@pytest.fixture
def held(request, tmp_path):
    """An armed stage in virtual time, at rest."""
    bench = Bench(tmp_path, request.param)
    bench.hold_as_homed_by_truth()
    yield bench
    bench.loop.leave()
    bench.loop.run()


def watched(bench, duration_s):
    """Let the stage hold for a while; returns its fault, None where it has none."""
    wire = bench.loop._stage.backend.wire
    until_t_ns = wire.t_ns + round(1e9 * duration_s)
    bench.until(lambda: bench.status.fault is not None or wire.t_ns > until_t_ns)
    return bench.status.fault


@pytest.mark.parametrize("held", ["oled-printer", "single-axis"], indirect=True)
def test_counts_that_repeat_to_the_last_bit_are_lost(held):
    assert watched(held, 5.0) is None  # its own noise repeats none for long
    held.inject(Fault("stuck_counts", duration_s=STUCK_S))
    fault = watched(held, WATCHED_S)
    assert fault is not None
    assert fault.kind == "REFERENCE_LOST"
    assert "macro counts are stuck: 13 samples after it repeat one to the last bit, limit 12" in fault.values


@pytest.mark.parametrize("held", ["oled-printer-umd2"], indirect=True)
def test_counts_coarser_than_the_noise_may_rest(held):
    held.inject(Fault("stuck_counts", duration_s=0.02))  # longer, and what it holds by drifts off
    assert watched(held, WATCHED_S) is None
