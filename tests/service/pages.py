"""The live page's own server on a free port, in this process, in front of a real service; and one in virtual time."""

import contextlib
import re
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx

from stagectl.page.admission import ENTRY, KEY_HEADER, Admission, Sessions
from stagectl.page.application import application
from stagectl.page.reports import Reports
from stagectl.service.access import Access, Role
from stagectl.service.api import application as api_of
from stagectl.service.desk import Desk
from stagectl.service.exposition import Figures
from stagectl.service.listener import Listener
from stagectl.service.notify import Notifier
from stagectl.service.places import listen_tcp, listen_unix
from stagectl.service.remembered import Remembered
from stagectl.service.service_log import ServiceLog
from stagectl.service.stage_loop import StageLoop
from stagectl.service.stage_state import Settings


class PageServer:
    """Serves the page until `end`."""

    def __init__(self, socket_path: Path, runs: Path):
        listening = listen_tcp(0)
        self.port = listening.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"
        self.sessions = Sessions()
        self._drawn = tempfile.TemporaryDirectory()
        served = application(socket_path, Reports(runs, Path(self._drawn.name)))
        self._listener = Listener([(listening, Admission(served, self.sessions, self.port))], lifespan="on")
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


class ServiceInVirtualTime:
    """A service on the rig in virtual time, in this process, until `end`."""

    def __init__(self, folder: Path, profile: Path):
        self.socket, self.runs = folder / "stage.socket", folder / "runs"
        log, figures = ServiceLog(None), Figures()
        desk = Desk(log)
        settings = Settings(str(profile), "batch", self.runs, folder / "state")
        self._loop = StageLoop(settings, desk, log, Remembered(), Notifier({}), figures)
        self._loop.show()
        api = Access(api_of(desk, log, figures, self.runs, "of this test"), None)
        self._listener = Listener([(listen_unix(self.socket), api)])
        self._listener.start()
        self._thread = threading.Thread(target=self._loop.run, name="stage")
        self._thread.start()

    def end(self) -> None:
        self._loop.leave()
        self._thread.join()
        self._listener.close()
