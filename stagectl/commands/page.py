"""`stagectl page`: the live page on this machine's own address, for browsers on this machine."""

import json
import tempfile
import time
from pathlib import Path

from stagectl.commands.answer import Answer, Voice, say_line
from stagectl.page.admission import ENTRY, Admission, Sessions
from stagectl.page.application import application
from stagectl.page.reports import Reports
from stagectl.service.access import Role
from stagectl.service.listener import Listener
from stagectl.service.places import default_socket, is_served, listen_tcp

_LOOK_S = 0.1
_ROLES = {Role.OPERATE: "to operate", Role.OBSERVE: "to watch  "}


def page(voice: Voice, socket: Path | None, port: int, runs_root: Path, as_json: bool) -> Answer:
    """Serve the page until Ctrl-C; a link that was used is followed by the next one.

    Errors: LinkError, RequestError.
    """
    path = socket or default_socket()
    listening = listen_tcp(port, "--port")
    address = f"http://127.0.0.1:{listening.getsockname()[1]}"
    if not is_served(path):
        voice.warn(f"{path}: no service answers there yet; the page waits for `stagectl serve`")

    def show(role: Role) -> None:
        # On stdout, where scripts look; a token in the address works once and is worthless after that.
        url = f"{address}{ENTRY}?token={sessions.link_token(role)}"
        say_line(json.dumps({"role": role, "url": url}) if as_json else f"{_ROLES[role]}  {url}")

    sessions = Sessions(show)
    with tempfile.TemporaryDirectory(prefix="stagectl-page-") as drawn:
        served = application(path, Reports(runs_root, Path(drawn)))
        admission = Admission(served, sessions, listening.getsockname()[1])
        listener = Listener([(listening, admission)], lifespan="on", from_operator=admission.is_from_operator)
        listener.start()
        try:
            for role in _ROLES:
                show(role)
            voice.note("each link works once, the next one is shown then; Ctrl-C ends the page, not the service")
            while True:
                time.sleep(_LOOK_S)
                voice.check()
        finally:
            listener.close()
