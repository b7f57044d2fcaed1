"""The live page's own server on a free port, in this process, in front of a real service."""

import contextlib
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import httpx

from stagectl.page.admission import ENTRY, KEY_HEADER, Admission, Sessions
from stagectl.page.application import application
from stagectl.page.reports import Reports
from stagectl.service.access import Role
from stagectl.service.listener import Listener
from stagectl.service.places import listen_tcp


class PageServer:
    """Serves the page until `end`."""

    def __init__(self, socket_path: Path, runs: Path):
        listening = listen_tcp(0)
        self.port = listening.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"
        self.sessions = Sessions()
        self._drawn = tempfile.TemporaryDirectory()
        self.drawn = Path(self._drawn.name)
        served = application(socket_path, Reports(runs, self.drawn))
        admission = Admission(served, self.sessions, self.port)
        self._listener = Listener([(listening, admission)], lifespan="on", from_operator=admission.is_from_operator)
        self._listener.start()

    def link(self, role: Role) -> str:
        return f"{self.address}{ENTRY}?token={self.sessions.link_token(role)}"

    @contextlib.contextmanager
    def browser(self, role: Role) -> Iterator[httpx.Client]:
        """Be a client that came in by a link, and says where it is from as the page does."""
        with httpx.Client(base_url=self.address, timeout=60.0, trust_env=False) as client:
            client.headers["Origin"] = self.address
            entered = client.get(self.link(role))
            assert entered.status_code == 200
            client.headers[KEY_HEADER] = re.search(r"url=/#([\w-]+)", entered.text)[1]
            yield client

    def end(self) -> None:
        self._listener.close()
        self._drawn.cleanup()
