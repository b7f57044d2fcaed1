"""One daemon for all tests that leave it as they found it."""

import pytest

from tests.service.daemon import Daemon, at_rest


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
    yield from at_rest(daemon)
