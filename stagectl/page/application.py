"""What the page's process answers: the page, the service's API passed on, the stream, and reports."""

import asyncio
import contextlib
import html
import re
import time
from collections.abc import AsyncIterator
from pathlib import Path

import httpx
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from stagectl.errors import StagectlError
from stagectl.page.feed import Feed
from stagectl.page.reports import Reports
from stagectl.service.access import Role

ASSETS = Path(__file__).parent / "assets"

_PASSED_ON = re.compile(r"[a-z]+(/[A-Za-z0-9._:-]{1,100})?")
_HEADERS_PASSED_ON = ("content-type", "idempotency-key", "stagectl-lease")
_TIMEOUT_S, _SEND_S = 5.0, 5.0
_GOING_AWAY = 1001  # RFC 6455, 7.4.1: "a browser having navigated away from a page"
_TOKEN_MOST = 100
_KEPT_S = {"runs": 2.0, "log": 1.0}  # what every page asks for again and again
_SERVICE = "http://stagectl"
# A report brings its own style and drawings, and no script.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"


def application(socket_path: Path, reports: Reports) -> Starlette:
    """Make the application of one page process; whoever gets as far as here was let in with a role."""
    feed = Feed(socket_path)
    service = httpx.AsyncClient(
        transport=httpx.AsyncHTTPTransport(uds=str(socket_path)), base_url=_SERVICE, timeout=_TIMEOUT_S
    )

    @contextlib.asynccontextmanager
    async def alive(app: Starlette) -> AsyncIterator[None]:
        hearing = asyncio.create_task(feed.work())
        try:
            yield
        finally:
            hearing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await hearing
            await service.aclose()

    async def index(request: Request) -> Response:
        return FileResponse(ASSETS / "index.html")

    async def session(request: Request) -> Response:
        return JSONResponse({"role": request.scope["stagectl_role"]})

    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        leaving = asyncio.create_task(_lease_left_behind(socket))
        sending = asyncio.create_task(_send(socket, feed))
        await asyncio.wait((leaving, sending), return_when=asyncio.FIRST_COMPLETED)
        sending.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await sending
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close()
        token = ""
        with contextlib.suppress(TimeoutError):
            token = await asyncio.wait_for(leaving, _SEND_S)
        if token and socket.scope["stagectl_role"] is Role.OPERATE:
            with contextlib.suppress(httpx.HTTPError):  # it runs out by itself
                await service.delete("/v1/lease", headers={"stagectl-lease": token})

    async def report(request: Request) -> Response:
        try:
            path = await reports.report(request.path_params["name"])
        except StagectlError as error:
            return HTMLResponse(f"<!doctype html><title>no report</title><pre>{html.escape(str(error))}</pre>", 404)
        return FileResponse(path, media_type="text/html", headers={"content-security-policy": _REPORT_POLICY})

    return Starlette(
        routes=[
            Route("/", index),
            Route("/session", session),
            Route("/runs/{name}/report", report),
            WebSocketRoute("/v1/stream", stream),
            Route("/v1/{path:path}", _Relay(service).pass_on, methods=["GET", "POST", "PUT", "DELETE"]),
            Mount("/assets", StaticFiles(directory=ASSETS)),
        ],
        lifespan=alive,
    )


async def _send(socket: WebSocket, feed: Feed) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
        async for text in feed.listen():
            await asyncio.wait_for(socket.send_text(text), _SEND_S)


async def _lease_left_behind(socket: WebSocket) -> str:
    """Wait until the page is gone; return the token of the lease that it left behind, empty where there is none.

    A page says its token whenever that changes. It is gone for good where its browser says so, which it does for a page
    that crashed too. The page itself can't do this: a request from its `pagehide` got lost on busy hosts.
    Where the connection breaks without a word, the page may come back: its lease is left to run out.
    """
    token = ""
    while (said := await socket.receive())["type"] != "websocket.disconnect":
        text = said.get("text") or ""
        sendable = len(text) <= _TOKEN_MOST and text.isascii() and text.isprintable()  # in a header
        token = text if sendable else ""
    return token if said.get("code") == _GOING_AWAY else ""


class _Relay:
    """Passes requests on to the service and its answers back; runs and log are read once for all pages."""

    def __init__(self, service: httpx.AsyncClient):
        """`service` reaches the service's socket."""
        self._service = service
        self._kept: dict[str, tuple[float, str, Response]] = {}
        self._reading = {path: asyncio.Lock() for path in _KEPT_S}

    async def pass_on(self, request: Request) -> Response:
        """Answer one request of a page."""
        path = request.path_params["path"]
        if not _PASSED_ON.fullmatch(path):
            return _failure(404, f"/v1/{path[:80]}: the service has no such place; GET /openapi.json there lists them")
        if request.method == "GET" and path in _KEPT_S:
            return await self._recent(request, path)
        return await self._ask(request, path)

    async def _recent(self, request: Request, path: str) -> Response:
        async with self._reading[path]:
            query = request.url.query
            at_s, asked, answer = self._kept.get(path, (0.0, "", None))
            if answer is None or asked != query or time.monotonic() - at_s > _KEPT_S[path]:
                answer = await self._ask(request, path)
                self._kept[path] = time.monotonic(), query, answer
            return answer

    async def _ask(self, request: Request, path: str) -> Response:
        headers = {name: request.headers[name] for name in _HEADERS_PASSED_ON if name in request.headers}
        try:
            answer = await self._service.request(
                request.method,
                f"/v1/{path}",
                params=httpx.QueryParams(request.url.query),
                headers=headers,
                content=await request.body(),
                timeout=_TIMEOUT_S,
            )
        except httpx.HTTPError as error:
            return _failure(502, f"no answer from the service ({error}); is `stagectl serve` running?")
        return Response(answer.content, answer.status_code, media_type=answer.headers.get("content-type"))


def _failure(code: int, message: str) -> JSONResponse:
    return JSONResponse({"kind": "LinkError", "message": message}, status_code=code)
