"""The API: what each route takes and answers. It only ever talks to the desk; nothing here touches the stage."""

import asyncio
import contextlib
import secrets
import time
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Header, Query, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from stagectl.errors import RequestError, StagectlError
from stagectl.service import messages
from stagectl.service.access import Role
from stagectl.service.desk import Busy, Desk, Ending, Unfit
from stagectl.service.exposition import Figures
from stagectl.service.lease import LeaseRefused
from stagectl.service.run_list import RunList
from stagectl.service.scope import COLUMNS
from stagectl.service.service_log import ServiceLog
from stagectl.service.used_keys import ANSWERS_COUNT

_WAIT_STEP_S = 0.02
_WAIT_MOST_S = 25.0
SEND_S = 5.0
"""How long a stream waits for room to write more."""

_CODES: tuple[tuple[type[StagectlError], int], ...] = (
    (LeaseRefused, 423),
    (Busy, 409),
    (Unfit, 422),
    (Ending, 503),
    (RequestError, 409),
)
_REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"model": messages.Failure, "description": text}
    for code, text in (
        (400, "The body can't be read"),
        (401, "No token, or a wrong one (TCP only)"),
        (403, "The token's role may not do this"),
        (409, "Not possible in this state, or another command is under way"),
        (413, "The body is too large"),
        (422, "A value is not what it must be, or its key was used for another command, or long ago"),
        (423, "The lease on motion is another's, over, or was not given"),
        (503, "The service begins or ends"),
    )
}

IdempotencyLeaseKey = Annotated[
    messages.LeaseKey | None,
    Header(alias="Idempotency-Key", description="The same key gets the same lease again, while that lasts"),
]
LeaseToken = Annotated[
    str, Header(alias="Stagectl-Lease", max_length=200, description="Token of the lease; without it, 423")
]
IdempotencyKey = Annotated[
    messages.Key | None,
    Header(alias="Idempotency-Key", description="The same key is the same command, however often it is sent"),
]


def _role(request: Request) -> Role:
    return request.scope["stagectl_role"]


def _operate(request: Request) -> None:
    if _role(request) is not Role.OPERATE:
        raise HTTPException(403, "this token may observe only; take that of the role operate")


_OPERATES = [Depends(_operate)]


def application(desk: Desk, log: ServiceLog, figures: Figures, runs_root: Path, version: str) -> FastAPI:
    """Make the application of one service."""
    app = FastAPI(
        title="stagectl",
        version=version,
        description="A macro-micro stage. Every command that moves, arms or acknowledges needs the lease; a stop needs "
        "none. Numbers are SI, units stand in the names.",
        docs_url=None,
        redoc_url=None,
        responses=_REFUSALS,
    )
    _answer_errors(app)
    _watch_routes(app, desk, log, figures, runs_root)
    _lease_routes(app, desk)
    _command_routes(app, desk)
    _stream_route(app, desk)
    return app


def _failure(code: int, kind: str, message: str) -> JSONResponse:
    return JSONResponse({"kind": kind, "message": message}, status_code=code)


def _answer_errors(app: FastAPI) -> None:
    @app.exception_handler(StagectlError)
    async def refused(request: Request, error: StagectlError) -> JSONResponse:
        code = next((code for kind, code in _CODES if isinstance(error, kind)), 500)
        return _failure(code, type(error).__name__, str(error))

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        answer = _failure(error.status_code, "AccessError", str(error.detail))
        answer.headers.update(error.headers or {})
        return answer

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        return _failure(422, "RequestError", "; ".join(messages.sentence(one) for one in error.errors()[:10]))


def _watch_routes(app: FastAPI, desk: Desk, log: ServiceLog, figures: Figures, runs_root: Path) -> None:
    run_list = RunList(runs_root)

    @app.get("/v1/status")
    async def status() -> messages.Status:
        """Where things stand."""
        return desk.status()

    @app.get("/v1/fault")
    async def fault() -> messages.Fault | None:
        """Why the stage stopped by itself; null where it did not."""
        return desk.status().fault

    @app.get("/v1/log")
    async def entries(
        after: Annotated[int | None, Query(ge=0, le=10**12)] = None, limit: Annotated[int, Query(ge=1, le=1000)] = 100
    ) -> list[messages.LogEntry]:
        """What the service did, behind a number, or the newest."""
        return log.last(limit) if after is None else log.after(after, limit)

    @app.get("/v1/runs")
    async def runs() -> list[messages.RunEntry]:
        """What was recorded, oldest first; rows of a run under way are not counted."""
        return [
            messages.RunEntry(
                name=run.folder.name,
                state=run.state,
                rows_count=run.rows_count,
                duration_s=run.duration_s,
                profile=run.profile,
                stop=run.stop,
                text=run.note or run.text,
            )
            for run in await run_list.summaries()
        ]

    @app.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def metrics() -> Response:
        """What Prometheus scrapes."""
        return Response(figures.exposition(desk.status()), media_type="text/plain; version=0.0.4; charset=utf-8")


def _lease_routes(app: FastAPI, desk: Desk) -> None:
    @app.get("/v1/lease")
    async def lease() -> messages.LeaseState | None:
        """Who may move the stage; null where nobody does."""
        return desk.lease_state()

    @app.post("/v1/lease", dependencies=_OPERATES)
    async def take(body: messages.TakeLease, key: IdempotencyLeaseKey = None) -> messages.TakenLease:
        """Take the lease, where it is free; whoever has the token may move the stage until it runs out."""
        return desk.take_lease(body, key or "")

    @app.put("/v1/lease", dependencies=_OPERATES)
    async def renew(token: LeaseToken = "") -> messages.TakenLease:
        """Renew the lease; once it has run out it can't be renewed."""
        return desk.renew_lease(token)

    @app.delete("/v1/lease", dependencies=_OPERATES, status_code=204)
    async def give_back(key: IdempotencyKey = None, token: LeaseToken = "") -> None:
        """Give the lease back; a stage with power is brought to rest and disarmed."""
        desk.give_lease_back(token, key or "")


def _command_routes(app: FastAPI, desk: Desk) -> None:
    def taker(name: str, model: type, text: str) -> None:
        async def take(body: Any, key: IdempotencyKey = None, token: LeaseToken = "") -> messages.Command:
            return desk.submit(name, body, key or f"made-{secrets.token_hex(12)}", token)

        take.__annotations__["body"] = model
        take.__doc__ = text
        take.__name__ = name
        app.post(f"/v1/{name}", status_code=202, dependencies=_OPERATES)(take)

    def planner(name: str, model: type, text: str) -> None:
        def take(body: Any, key: IdempotencyKey = None, token: LeaseToken = "") -> messages.Command:
            return desk.submit_planned(name, body, key or f"made-{secrets.token_hex(12)}", token)

        take.__annotations__["body"] = model
        take.__doc__ = text
        take.__name__ = name
        app.post(f"/v1/{name}", status_code=202, dependencies=_OPERATES)(take)  # planned in a thread of its own

    taker("arm", messages.Arm, "Give the drives power and hold; the stage must be homed.")
    taker("home", messages.Home, "Home: the macro on its index, the micro on both edges; ends armed.")
    taker("move", messages.Move, "Move the end to a position.")
    taker("jog", messages.JogBy, "Move the end by a distance.")
    taker("identify", messages.Identify, "Identify the backlash by a sweep over both edges.")
    taker("probe", messages.Probe, "Touch both edges of the joint with 5 N at most, where the profile permits it.")
    taker("acknowledge", messages.Acknowledge, "Take note of a fault; enables nothing.")
    taker("backend", messages.SwapBackend, "Work in another world; without power only.")
    taker("reread", messages.Home, "Read the profile again; without power only.")

    planner("scan", messages.Scan, "Follow a scan program; checked against all limits before the first cycle.")
    planner("follow", messages.Follow, "Follow a table of times and positions; checked before the first cycle.")

    def checker(name: str, model: type) -> None:
        def check(body: Any, token: LeaseToken = "") -> None:
            desk.check(name, body, token)

        check.__annotations__["body"] = model
        check.__doc__ = (
            f"Tell whether this stage could do that {name}, before it is homed and armed for it; 422 if not."
        )
        check.__name__ = f"check_{name}"
        app.post(f"/v1/check/{name}", status_code=204, dependencies=_OPERATES)(check)  # plans too: in a thread

    checker("move", messages.Move)
    checker("jog", messages.JogBy)
    checker("identify", messages.Identify)
    checker("probe", messages.Probe)
    checker("scan", messages.Scan)
    checker("follow", messages.Follow)
    checker("setpoints", messages.Setpoints)

    @app.get("/v1/setpoints")
    async def stream_state() -> messages.StreamState | None:
        """How the stream under way stands; null where there is none."""
        return desk.stream_state()

    @app.put("/v1/setpoints", status_code=202, dependencies=_OPERATES)
    def setpoints(body: messages.Setpoints, key: IdempotencyKey = None, token: LeaseToken = "") -> messages.StreamState:
        """Send set-points ahead; number 0 begins. Where none comes in time the stage brakes and holds.

        The key is the stream's, the same with every request of it.
        """
        return desk.take_setpoints(body, token, key or "")

    @app.post("/v1/jogging", status_code=202, dependencies=_OPERATES)
    async def begin_jog(
        body: messages.BeginJog, key: IdempotencyKey = None, token: LeaseToken = ""
    ) -> messages.Command:
        """Begin to jog, at rest; the answer's key is what the velocities are said to."""
        return desk.begin_jog(body, key or f"jog-{secrets.token_hex(8)}", token)

    @app.put("/v1/jogging/{key}", status_code=202, dependencies=_OPERATES)
    async def jog_at(key: messages.Key, body: messages.JogAt, token: LeaseToken = "") -> messages.Command:
        """Jog at a velocity; say it again before `hold_s` is over, or that jog ends for good (409)."""
        return desk.jog_at(key, body, token)

    @app.post("/v1/stop", status_code=202, dependencies=_OPERATES)
    async def stop() -> messages.Status:
        """Bring the stage to rest and take the power away. Needs no lease."""
        desk.ask_to_stop("a client asked to stop")
        return desk.status()

    @app.post("/v1/record", status_code=202, dependencies=_OPERATES)
    async def record(body: messages.StartRecord, key: IdempotencyKey = None) -> messages.Status:
        """Begin a run, where none is under way. Needs no lease; motions are recorded without asking."""
        desk.ask_to_record(body.name, key or "")
        return desk.status()

    @app.delete("/v1/record", status_code=202, dependencies=_OPERATES)
    async def end_record(key: IdempotencyKey = None) -> messages.Status:
        """End the run that was asked for. Needs no lease."""
        desk.ask_to_record("", key or "")
        return desk.status()

    @app.put("/v1/record/trigger", status_code=202, dependencies=_OPERATES)
    async def set_trigger(body: messages.SetTrigger, key: IdempotencyKey = None) -> messages.Status:
        """Record what is around an event, beside whatever else is recorded. Needs no lease."""
        desk.set_trigger(body, key or "")
        return desk.status()

    @app.delete("/v1/record/trigger", status_code=202, dependencies=_OPERATES)
    async def end_trigger(key: IdempotencyKey = None) -> messages.Status:
        """Wait for no event any more. Needs no lease."""
        desk.set_trigger(None, key or "")
        return desk.status()

    @app.get("/v1/commands/{key}", responses={404: {"model": messages.Failure}})
    async def command(
        key: messages.Key, wait_s: Annotated[float, Query(ge=0.0, le=_WAIT_MOST_S, allow_inf_nan=False)] = 0.0
    ) -> messages.Command:
        """What became of a command; waits for its end where asked to."""
        until_s = time.monotonic() + wait_s
        while True:
            found = desk.command(key)
            if found is None:
                raise HTTPException(404, f"no command with key {key!r} is remembered; the last {ANSWERS_COUNT} are")
            if found.state in ("done", "failed") or time.monotonic() >= until_s:
                return found
            await asyncio.sleep(_WAIT_STEP_S)


def _stream_route(app: FastAPI, desk: Desk) -> None:
    @app.websocket("/v1/stream")
    async def stream(socket: WebSocket, rate_hz: Annotated[float, Query(ge=0.5, le=30.0)] = 10.0) -> None:
        """Status and thinned-out samples, at the client's rate; a client that doesn't read is let go of."""
        await socket.accept()
        number = desk.scope.after(-1).last
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            with contextlib.suppress(TimeoutError):
                while True:
                    scope = desk.scope
                    samples = scope.after(number if number <= scope.after(-1).last else 0)
                    number = samples.last
                    rows = [[_json(value) for value in row] for row in samples.rows]
                    message = {"status": desk.status().model_dump(), "samples": {"columns": COLUMNS, "rows": rows}}
                    await asyncio.wait_for(socket.send_json(message), SEND_S)
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(_closed(socket), 1.0 / rate_hz)
                        return
            await socket.close(
                1013, f"there was no room for more in {SEND_S:g} s; read faster, or ask for a lower rate_hz"
            )


async def _closed(socket: WebSocket) -> None:
    """Wait until the client is gone; what it says is not listened to."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def _json(value: float) -> float | None:
    return value if value == value and abs(value) != float("inf") else None
