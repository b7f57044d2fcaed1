"""Shipped profiles and machines, read once."""

import gc
import os
import signal

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does; before numpy is loaded

from sim_backend.machine import load_machine
from stagectl.profile import load_profile
from tests.host_pauses import RERUN_COUNT, HostPauses

# Compiling makes objects by the million and hardly a circle; looking for those every 700 was 6 % of the tests' time.
gc.set_threshold(100_000, 10, 10)

settings.register_profile("stagectl", deadline=None)  # a first call compiles
settings.load_profile("stagectl")

# A shell that starts us in the background, or `nohup`, has these ignored, and what we start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Run a real-time test again that failed while the host took a processor away."""
    judged = [item for item in items if item.get_closest_marker("real_time")]
    if judged and not config.option.collectonly:
        host = HostPauses()
        config.pluginmanager.register(host)
        for item in judged:
            item.add_marker(pytest.mark.flaky(reruns=RERUN_COUNT, condition=host.excuse))


@pytest.fixture(scope="session")
def oled_profile():
    """What is believed of the default stage."""
    return load_profile("oled-printer")


@pytest.fixture(scope="session")
def oled_machine():
    """What the default stage is."""
    return load_machine("oled-printer")


@pytest.fixture(scope="session")
def single_profile():
    """What is believed of a stage with one axis."""
    return load_profile("single-axis")


@pytest.fixture(scope="session")
def single_machine():
    """What a stage with one axis is."""
    return load_machine("single-axis")
