"""The thread that listens: one uvicorn for each socket, on one event loop, beside the stage's thread."""

import asyncio
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Literal

import uvicorn

from stagectl.service.access import Application, Scope
from stagectl.service.admission import Admission, Connection, let_go_of_the_deaf

_CLOSE_S = 2.0
_START_S = 10.0


def _server(
    application: Application, lifespan: Literal["on", "off"], from_operator: Callable[[Scope], bool]
) -> uvicorn.Server:
    admission = Admission(application, lambda: len(server.server_state.connections), from_operator)
    server = uvicorn.Server(
        uvicorn.Config(
            admission,  # pyright: ignore[reportArgumentType]
            http=Connection,
            lifespan=lifespan,
            log_config=None,
            access_log=False,
            ws="websockets-sansio",
            ws_max_size=4096,
            timeout_graceful_shutdown=int(_CLOSE_S),
            server_header=False,
        )
    )
    return server


class Listener:
    """Serves applications on sockets until `close`."""

    def __init__(
        self,
        served: Sequence[tuple[socket.socket, Application]],
        lifespan: Literal["on", "off"] = "off",
        ended: Callable[[], None] = lambda: None,
        from_operator: Callable[[Scope], bool] = lambda scope: False,
    ):
        """Take sockets that listen already; nothing is answered before `start`.

        `lifespan` "on": the applications are told of their beginning and end. `ended` is called, from the thread that
        listens, where it stops answering without having been closed. `from_operator` tells which requests are answered
        however many clients there are.
        """
        self._ended, self._closing = ended, False
        self.has_failed = False
        self._sockets = [listening for listening, _ in served]
        self._servers = [_server(application, lifespan, from_operator) for _, application in served]
        self._thread = threading.Thread(target=self._work, name="api", daemon=True)

    def start(self) -> None:
        """Answer from now on."""
        self._thread.start()

    def _work(self) -> None:
        try:
            asyncio.run(self._serve())
        finally:
            if not self._closing:
                self.has_failed = True
                self._ended()

    async def _serve(self) -> None:
        looking = [asyncio.create_task(let_go_of_the_deaf(server.server_state.connections)) for server in self._servers]
        served = zip(self._servers, self._sockets, strict=True)
        try:
            await asyncio.gather(*(server.serve(sockets=[listening]) for server, listening in served))
        finally:
            for task in looking:
                task.cancel()

    def close(self) -> None:
        """Answer no more."""
        self._closing = True
        for server in self._servers:
            server.should_exit = True
        self._thread.join(_START_S)
        for listening in self._sockets:
            listening.close()
