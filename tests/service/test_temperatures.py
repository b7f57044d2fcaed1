"""The drives' temperatures through a service on the rig: warmed by current, and a drive that does not say."""

import io
import re

import pytest
from rich.console import Console

from sim_backend.faults import Fault
from stagectl.commands.watching import status_table
from stagectl.profile import PROFILES_FOLDER
from stagectl.service import messages
from stagectl.temperatures import UNREAD, WARNING
from tests.service.served import Served
from tests.toml_text import changed

WARNING_DEGC = 20.1  # 0.1 K above the air of the rig's machine: some seconds of to and fro
MACRO_ANSWERS = 0x581  # the COB-ID of node 1's SDO server


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("warm")
    profile = folder / "warm.toml"
    profile.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"macro.temperature.warning_degc": WARNING_DEGC}))
    served = Served(folder, profile)
    yield served
    served.close()


@pytest.fixture
def warm(made):
    """That stage without power."""
    made.recovers()
    yield made
    made.recovers()


def gauge(daemon, name):
    found = re.search(rf'^stagectl_drive_temperature_{name}{{axis="macro"}} (\S+)$', daemon.client.metrics(), re.M)
    return None if found is None else float(found[1])


def said(daemon, event):
    return [entry for entry in daemon.client.log(limit=200) if entry.event == event]


def test_current_warms_a_drive_and_metrics_status_and_log_say_so(warm):
    client = warm.client
    warm.until(lambda: gauge(warm, "celsius") is not None)
    assert 20.0 <= gauge(warm, "celsius") < WARNING_DEGC
    assert gauge(warm, "warning") == 0.0
    assert said(warm, WARNING) == []
    to_and_fro = [messages.Segment(target_m=0.01), messages.Segment(target_m=-0.01)]
    client.take_lease("shaker", 30.0)
    client.arm()
    while gauge(warm, "warning") == 0.0:
        assert client.scan(messages.Scan(segments=to_and_fro, repeat_count=20)).stop == "FINISHED"
    shown = client.status()
    client.give_lease_back()
    assert gauge(warm, "celsius") >= WARNING_DEGC
    (entry,) = said(warm, WARNING)
    assert entry.fields["axis"] == "macro"
    assert entry.fields["degc"] >= WARNING_DEGC
    assert set(shown.temperatures) == {"macro"}
    assert shown.temperatures["macro"].warning
    assert shown.temperatures["macro"].age_s >= 0.0
    console = Console(record=True, width=200, file=io.StringIO())
    console.print(status_table(shown))
    assert re.search(r"drives +macro 2\d\.\d degC, warning", console.export_text())


def test_a_drive_that_does_not_say_is_given_up_and_its_stage_holds(warm):
    """Three answers that never come cost 50 ms each of a supervisor that the servo gives 0.5 s."""
    client = warm.client
    client.take_lease("holder", 30.0)
    client.arm()
    warm.inject(Fault("drop_frame", can_id=MACRO_ANSWERS, duration_s=1e6))
    (entry,) = warm.until(lambda: said(warm, UNREAD))
    assert "No SDO response" in entry.text
    assert client.status().temperatures == {}
    assert gauge(warm, "celsius") is None
    assert client.status().state == "armed"
