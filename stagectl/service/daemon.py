"""`stagectl serve`: the parts put together. The main thread is the stage's, a second one answers clients."""

import contextlib
import gc
import os
import signal
import socket
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from stagectl.errors import LinkError, RequestError
from stagectl.left_memory import remove_left_blocks
from stagectl.left_runs import finish_left_runs
from stagectl.record import recover_orphans
from stagectl.service.access import LEASE_HEADER, Access, Application, header, read_tokens
from stagectl.service.api import application
from stagectl.service.desk import Desk
from stagectl.service.exposition import Figures
from stagectl.service.listener import Listener
from stagectl.service.notify import Notifier
from stagectl.service.places import listen_tcp, listen_unix, one_service_of
from stagectl.service.remembered import recall
from stagectl.service.service_log import ServiceLog
from stagectl.service.stage_loop import StageLoop
from stagectl.service.stage_state import Settings

TOKENS = "tokens"


def serve(
    settings: Settings, socket_path: Path, tcp_port: int | None, take_over: Callable[[], None] = lambda: None
) -> None:
    """Serve one stage until SIGTERM. Errors: LinkError, ProfileError, RecordError, RequestError before it begins.

    `take_over` is called when signals are heard here, before anything is begun.
    """
    log, notifier, figures = ServiceLog(), Notifier(), Figures()
    remembered, remark = recall(settings.state_folder)
    if remark:
        log.say("state_lost", remark)
    asked = settings.profile or remembered.profile
    if not asked:
        raise RequestError("which profile? none was served before; give one: stagectl serve PROFILE")
    settings = replace(settings, profile=asked)
    desk = Desk(log)
    loop = StageLoop(settings, desk, log, remembered, notifier, figures)
    hear_signals(loop)
    take_over()
    with contextlib.ExitStack() as held:
        held.enter_context(one_service_of(settings.state_folder))
        listener = Listener(
            _sockets(held, settings, desk, log, figures, socket_path, tcp_port),
            ended=lambda: os.kill(os.getpid(), signal.SIGTERM),  # heard by the stage's thread
            from_operator=lambda scope: desk.is_lease_token(header(scope, LEASE_HEADER)),
        )
        for ring, outcome in recover_orphans():
            log.say("recovered", str(outcome), ring=str(ring))
        remove_left_blocks()
        for folder, outcome in finish_left_runs(settings.runs_root):
            log.say("recovered", str(outcome), run=folder.name)
        keep_for_good()
        loop.recall_fault()
        loop.show()  # whoever asks first is answered
        listener.start()
        notifier.say(READY=1, STATUS="listening")
        try:
            loop.run()
        finally:
            listener.close()
            log.say("ended")
    if listener.has_failed:
        raise LinkError("clients were no longer answered, why stands above; the stage came to rest: start again")


def _sockets(
    held: contextlib.ExitStack,
    settings: Settings,
    desk: Desk,
    log: ServiceLog,
    figures: Figures,
    socket_path: Path,
    tcp_port: int | None,
) -> list[tuple[socket.socket, Application]]:
    """Listen where it was asked for. Errors: LinkError, ProfileError, RecordError, RequestError."""
    api = application(desk, log, figures, settings.runs_root, metadata.version("stagectl"))
    sockets: list[tuple[socket.socket, Application]] = [(listen_unix(socket_path), Access(api, None))]
    held.callback(socket_path.unlink, missing_ok=True)
    log.say("listening", str(socket_path))
    if tcp_port is not None:
        tokens_path = settings.state_folder / TOKENS
        tokens = read_tokens(tokens_path)
        listening = listen_tcp(tcp_port)
        sockets.append((listening, Access(api, tokens)))
        log.say("listening", f"127.0.0.1:{listening.getsockname()[1]}, tokens in {tokens_path}")
    return sockets


def keep_for_good() -> None:
    """Take what is here now out of all later collections.

    A whole collection waits for a quarter more objects than the last one left. With 120,000 of the libraries among them
    that was minutes of what requests leave in circles: 1.5 MB up and down.
    """
    gc.collect()
    gc.freeze()
    gc.collect()


def hear_signals(loop: StageLoop) -> None:
    """SIGTERM and Ctrl-C end the service, SIGHUP has it read its profile again."""
    signal.signal(signal.SIGTERM, lambda number, frame: loop.leave())
    signal.signal(signal.SIGINT, lambda number, frame: loop.leave())
    signal.signal(signal.SIGHUP, lambda number, frame: loop.reread())
