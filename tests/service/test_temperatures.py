"""The drives' temperatures through a real service on the rig: warmed by current, and a drive that does not say."""

import contextlib
import io
import re

import pytest
from rich.console import Console

from stagectl.backend import ask_rig
from stagectl.commands.remote import status_table
from stagectl.errors import RequestError
from stagectl.service import messages
from stagectl.temperatures import UNREAD, WARNING
from tests.service.daemon import PATIENT, Daemon

pytestmark = pytest.mark.real_time

WARNING_DEGC = 20.2  # 0.2 K above the air of the rig's machine: some seconds of to and fro


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    made = Daemon(tmp_path_factory.mktemp("warm"), PATIENT | {"macro.temperature.warning_degc": WARNING_DEGC})
    try:
        made.state_is("idle")
        yield made
    finally:
        made.end()


def gauge(daemon, name):
    found = re.search(rf'^stagectl_drive_temperature_{name}{{axis="macro"}} (\S+)$', daemon.client.metrics(), re.M)
    return None if found is None else float(found[1])


def said(daemon, event):
    return [entry for entry in daemon.client.log(limit=200) if entry.event == event]


def armed(daemon):
    """Home and arm; after a hiccup of the host once more."""
    for _ in range(2):
        with contextlib.suppress(RequestError):
            if daemon.client.home().stop == "FINISHED" and daemon.client.arm().state == "done":
                return
        daemon.recovers()
    raise AssertionError("it can't be armed")


def test_current_warms_a_drive_and_metrics_status_and_log_say_so(warm):
    client = warm.client
    warm.until(lambda: gauge(warm, "celsius") is not None, "a temperature")
    assert 20.0 <= gauge(warm, "celsius") < WARNING_DEGC
    assert gauge(warm, "warning") == 0.0
    assert said(warm, WARNING) == []
    to_and_fro = [messages.Segment(target_m=0.01), messages.Segment(target_m=-0.01)]

    def warns():
        """Shake it, as often as it takes: a host that holds the servo up may end a shaking."""
        if client.status().state not in ("armed", "moving"):
            armed(warm)
        with contextlib.suppress(RequestError):
            client.scan(messages.Scan(segments=to_and_fro, repeat_count=20))
        warm.recovers()
        return gauge(warm, "warning") == 1.0

    with client.lease("shaker"):
        armed(warm)
        warm.until(warns, "a warm drive")
        shown = client.status()
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
    warm.until(lambda: warm.client.lease_state() is None, "a free lease")


def test_a_drive_that_does_not_say_is_given_up_and_its_stage_holds(warm):
    """Three answers that never come cost 50 ms each of a supervisor that the servo gives 0.5 s."""
    client = warm.client
    warm.recovers()
    with client.lease("holder"):
        armed(warm)
        (channel,) = (warm.folder / "tmp").glob("stagectl-rig-*/can.socket")
        ask_rig(str(channel), {"fault": {"kind": "drop_frame", "can_id": 0x581, "duration_s": 1e6}})
        (entry,) = warm.until(lambda: said(warm, UNREAD), "a drive that is given up")
        assert "No SDO response" in entry.text
        assert client.status().temperatures == {}
        assert gauge(warm, "celsius") is None
        fault = client.fault()
        assert fault is None or fault.kind not in ("SUPERVISOR_SILENT", "LEASE", "HEARTBEAT_LOST")
