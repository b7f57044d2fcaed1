"""Who may do what: everybody who may open the Unix socket operates; on TCP a token says *observe* or *operate*.

An ASGI layer around the whole application, so that no route can forget it.
"""

import hmac
import os
import secrets
import stat
from collections.abc import Awaitable, Callable, MutableMapping
from enum import StrEnum
from pathlib import Path
from typing import Any

from stagectl.errors import ProfileError, RecordError

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

BODY_LIMIT_BYTES = 64 * 1024
TABLE_LIMIT_BYTES = 2 * 1024 * 1024
"""For a motion's table, on its own paths."""

LEASE_HEADER = b"stagectl-lease"
_TABLE_PATHS = ("/v1/follow", "/v1/check/follow")
_TOKEN_BYTES = 24
_LEAST_TOKEN_LETTERS = 20


class Role(StrEnum):
    """What a client may do."""

    OBSERVE = "observe"
    OPERATE = "operate"


def read_tokens(path: Path) -> dict[Role, str]:
    """Read the tokens of both roles, made where the file is missing; it must be nobody else's to read.

    Errors: ProfileError (what the file says, or who may read it), RecordError (it can't be made).
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        pass
    except OSError as error:
        raise RecordError(f"{path}: can't be made: {error.strerror}; give another folder with --state") from error
    else:
        with os.fdopen(descriptor, "w") as file:
            file.writelines(f"{role} {secrets.token_urlsafe(_TOKEN_BYTES)}\n" for role in Role)
    try:
        found = path.stat()
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: can't be read: {error}; remove it, and new tokens are made") from error
    if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise ProfileError(f"{path}: mode {stat.S_IMODE(found.st_mode):04o}, others may read it; chmod 600 {path}")
    tokens: dict[Role, str] = {}
    for line in lines:
        role, _, token = line.strip().partition(" ")
        if role in tuple(Role) and len(token) >= _LEAST_TOKEN_LETTERS and token.isascii():
            tokens[Role(role)] = token
    missing = [role.value for role in Role if role not in tokens]
    if missing or len(set(tokens.values())) != len(Role):
        raise ProfileError(
            f"{path}: needs a line 'ROLE TOKEN' for each of {', '.join(Role)}, different tokens of "
            f"{_LEAST_TOKEN_LETTERS} letters or more; remove it, and new ones are made"
        )
    return tokens


def role_of(tokens: dict[Role, str], given: str) -> Role | None:
    """Return the role of a token; compares with every one, in a time that says nothing."""
    found = None
    for role, token in tokens.items():
        if hmac.compare_digest(token.encode(), given.encode(errors="replace")):
            found = role
    return found


class Access:
    """Lets in who may come, with `stagectl_role` in the scope, and no body above the limit."""

    def __init__(self, application: Application, tokens: dict[Role, str] | None):
        """`tokens` None: whoever connects operates (the socket's own permissions decide)."""
        self._application, self._tokens = application, tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one connection on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        role = Role.OPERATE if self._tokens is None else role_of(self._tokens, _bearer(scope))
        if role is None:
            await refuse(scope, send, 401, "a token is needed: Authorization: Bearer TOKEN, as the tokens file has it")
            return
        await let_in(self._application, role, scope, receive, send)


async def let_in(application: Application, role: Role, scope: Scope, receive: Receive, send: Send) -> None:
    """Pass a connection on with its role, unless its body is above the limit."""
    scope["stagectl_role"] = role
    length = header(scope, b"content-length")
    most = TABLE_LIMIT_BYTES if scope.get("path") in _TABLE_PATHS and role is Role.OPERATE else BODY_LIMIT_BYTES
    if length and (not length.isdigit() or int(length) > most):
        await refuse(scope, send, 413, f"Content-Length {length[:20]}: the limit is {most} bytes")
        return
    if header(scope, b"transfer-encoding"):  # beside it a Content-Length says nothing: the pieces have no end
        await refuse(scope, send, 411, "send a Content-Length and no Transfer-Encoding; bodies in pieces are not taken")
        return
    await application(scope, receive, send)


def header(scope: Scope, name: bytes) -> str:
    """Return the first header of a name (lower case); empty where there is none."""
    for key, value in scope.get("headers", ()):
        if key == name:
            return value.decode("latin-1")
    return ""


def _bearer(scope: Scope) -> str:
    kind, _, token = header(scope, b"authorization").partition(" ")
    return token.strip() if kind.lower() == "bearer" else ""


async def refuse(scope: Scope, send: Send, code: int, message: str) -> None:
    """Answer a connection that may not come in: a status with JSON, or a closed WebSocket."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": message[:120]})
        return
    import json

    body = json.dumps({"kind": "AccessError", "message": message}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if code == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": code, "headers": headers})
    await send({"type": "http.response.body", "body": body})
