"""One daemon for all tests that leave it as they found it."""

import pytest

from tests.service.daemon import Daemon


@pytest.fixture(scope="package")
def daemon(tmp_path_factory):
    made = Daemon(tmp_path_factory.mktemp("daemon"))
    try:
        made.state_is("idle")
        yield made
    finally:
        made.end()


@pytest.fixture
def idle(daemon):
    """The daemon without power, whatever the last test left, or the host did meanwhile."""
    daemon.recovers()
    yield daemon
    daemon.until(lambda: daemon.client.status().state in ("idle", "fault", "off"), "rest")
    daemon.recovers()
    daemon.state_is("idle")
    daemon.until(lambda: daemon.client.lease_state() is None, "a free lease")
