"""Who may see the page: a link that works once becomes a cookie; Host and Origin are looked at before anything else.

An ASGI layer around the whole application, so that no route can forget it. Loopback alone is no protection: every
other page in the same browser can send requests here (cross-site requests, DNS rebinding), and other users of this
machine can connect. Nor is the cookie alone: a browser sends it to every port of 127.0.0.1, so that a server of
another user gets it as soon as somebody opens a page there. Commands therefore carry a key too, which stands in the
page's own storage: that is kept apart for each port.
"""

import hmac
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from urllib.parse import parse_qs

from stagectl.service.access import Application, Receive, Role, Scope, Send, header, let_in, refuse

_TOKEN_BYTES = 32
_SESSIONS_MOST = 64
_IDLE_S = 12 * 3600.0  # a page that is open asks for the log every few seconds
_WATCHING = ("GET", "HEAD")
ENTRY = "/enter"

HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"cache-control", b"no-store"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
)
"""What every answer carries, where its route says nothing else."""

# The cookie is Strict: a browser that came from elsewhere doesn't send it along a redirect, but after a page of ours.
# What stands behind # is sent nowhere: the page's script takes the key from there.
_ENTERED = (
    '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url=/#{0}"><a href="/#{0}">go on</a>'
)
_NO_SESSION = "open the link that `stagectl page` shows; each link works once, and the terminal has the next one"
KEY_HEADER = "stagectl-page"
_COOKIES_MOST = 32  # a browser has one a path that leads here, 7 at most; each costs 30 us, and 64 kB of them 85 ms


@dataclass(slots=True)
class Session:
    """A browser that came in by a link."""

    role: Role
    key: str
    """What its page says with every command."""
    used_at_s: float


class Sessions:
    """Links that nobody used yet, one a role, and the browsers that came in by one. They end with the process."""

    def __init__(
        self, renewed: Callable[[Role], None] = lambda role: None, clock_s: Callable[[], float] = time.monotonic
    ):
        """`renewed` is called when a link was used and the next one is there."""
        self._renewed, self._clock_s = renewed, clock_s
        self._links = {role: secrets.token_urlsafe(_TOKEN_BYTES) for role in Role}
        self._sessions: dict[str, Session] = {}

    def link_token(self, role: Role) -> str:
        """Return the token of the link that works next."""
        return self._links[role]

    def enter(self, token: str) -> tuple[str, Session] | None:
        """Use a link up and return the cookie's value with its session; None where it is none, or was used."""
        role = _found(self._links, token)
        if role is None:
            return None
        self._links[role] = secrets.token_urlsafe(_TOKEN_BYTES)
        value = secrets.token_urlsafe(_TOKEN_BYTES)
        while len(self._sessions) >= _SESSIONS_MOST:
            self._sessions.pop(next(iter(self._sessions)))  # the oldest
        session = self._sessions[value] = Session(role, secrets.token_urlsafe(_TOKEN_BYTES), self._clock_s())
        self._renewed(role)
        return value, session

    def session(self, value: str) -> Session | None:
        """Return the session of the browser with this cookie; None for a stranger, and after a long silence."""
        now_s = self._clock_s()
        self._sessions = {known: one for known, one in self._sessions.items() if now_s - one.used_at_s < _IDLE_S}
        found = next((one for known, one in self._sessions.items() if _same(known, value)), None)
        if found is not None:
            found.used_at_s = now_s
        return found


def _found(links: dict[Role, str], token: str) -> Role | None:
    return next((role for role, known in links.items() if _same(known, token)), None)


def _same(known: str, given: str) -> bool:
    return hmac.compare_digest(known.encode(), given.encode(errors="replace"))


class Admission:
    """Lets in who has the cookie, from our own address and our own page; an observer only ever watches."""

    def __init__(self, application: Application, sessions: Sessions, port: int):
        """`port` is where it is served: an address with another one is none of ours."""
        self._application, self._sessions = application, sessions
        self._hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self._cookie = f"stagectl-page-{port}"  # a browser's cookies know no ports

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one connection on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        send = _with_headers(send)
        strange = self._stranger(scope)
        if strange:
            await refuse(scope, send, 403, strange)
            return
        if scope["type"] == "http" and scope["path"] == ENTRY:
            await self._enter(scope, send)
            return
        session = self._session_of(scope)
        commands = scope["type"] == "http" and scope["method"] not in _WATCHING
        if session is None:
            await refuse(scope, send, 401, _NO_SESSION)
        elif commands and session.role is not Role.OPERATE:
            await refuse(scope, send, 403, "this page may only watch; open the link for operating in this browser")
        elif commands and not _same(session.key, header(scope, KEY_HEADER.encode())):
            await refuse(scope, send, 403, f"the page's key is missing or is another's: {_NO_SESSION}")
        else:
            await let_in(self._application, session.role, scope, receive, send)

    def is_from_operator(self, scope: Scope) -> bool:
        """Tell whether a request is from an operator's own page: it has cookie and key."""
        session = self._session_of(scope)
        if session is None or session.role is not Role.OPERATE or self._stranger(scope):
            return False
        return _same(session.key, header(scope, KEY_HEADER.encode()))

    def _stranger(self, scope: Scope) -> str:
        """Say why a request is not from our own page at our own address; empty where it is."""
        hosts = _all(scope, b"host")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return f"Host {', '.join(hosts)[:80] or 'is missing'}: this page is at {' or '.join(self._hosts)} only"
        origins = _all(scope, b"origin")
        asks = scope["type"] == "websocket" or scope["method"] not in _WATCHING
        if (origins or asks) and origins != [f"http://{hosts[0].lower()}"]:
            return f"Origin {', '.join(origins)[:80] or 'is missing'}: only the page itself may ask this"
        site = header(scope, b"sec-fetch-site")
        if site not in ("", "same-origin", "none") and scope["path"] != ENTRY:
            return f"Sec-Fetch-Site {site[:20]}: only the page itself may ask this"
        return ""

    async def _enter(self, scope: Scope, send: Send) -> None:
        token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        entered = self._sessions.enter(token) if scope["method"] == "GET" else None
        if entered is None:
            await refuse(scope, send, 401, f"this link is none, or was used: {_NO_SESSION}")
            return
        value, session = entered
        cookie = f"{self._cookie}={value}; Path=/; HttpOnly; SameSite=Strict"
        body = _ENTERED.format(session.key).encode()
        headers = [
            (b"content-type", b"text/html; charset=utf-8"),
            (b"content-length", str(len(body)).encode()),
            (b"set-cookie", cookie.encode()),
        ]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    def _session_of(self, scope: Scope) -> Session | None:
        """Return the session of whoever asks; of several, the one whose key came along, else one that operates.

        Other servers on 127.0.0.1 put cookies of theirs beside ours, of any form and of our name too: none of them may
        hide ours, or STOP would be refused.
        """
        key = header(scope, KEY_HEADER.encode())
        known = [self._sessions.session(value) for value in islice(self._cookies(scope), _COOKIES_MOST)]
        return max(
            (one for one in known if one is not None),
            key=lambda one: (_same(one.key, key), one.role is Role.OPERATE),
            default=None,
        )

    def _cookies(self, scope: Scope) -> Iterator[str]:
        for text in _all(scope, b"cookie"):
            for pair in text.split(";"):
                name, _, value = pair.partition("=")
                if name.strip(" \t") == self._cookie:
                    yield value.strip(" \t")


def _all(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope.get("headers", ()) if key == name]


def _with_headers(send: Send) -> Send:
    async def send_with_headers(message) -> None:
        if message["type"] == "http.response.start":
            given = {key for key, _ in message["headers"]}
            more = [(key, value) for key, value in HEADERS if key not in given]
            message = {**message, "headers": [*message["headers"], *more]}
        await send(message)

    return send_with_headers
