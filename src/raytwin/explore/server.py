"""The server behind the page: this machine alone, one page at a time, nothing from elsewhere.

Every request is judged before Bokeh sees it: its host must be this machine's loopback name (a foreign name that resolves here is
refused), its origin this page, its path one that the page needs. A second page gets a plain answer that tries again by itself,
so that a reloaded page opens as soon as the browser has let go of the one before.
"""

import contextlib
import getpass
import os
import shlex
import sys
import time
import webbrowser
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import InputError, MissingDependencyError

ADDRESS = "127.0.0.1"
DEFAULT_PORT = 5006
_PORTS_TRIED = 20  # from the default one, where none was asked for
_OPENING_S = 3.0  # from a page's first bytes to its connection
_PATHS = ("/", "/ws")
_BUSY = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="2">'
    "<title>raytwin explore</title></head><body><p>The explorer is open in another window. This page opens when that one is"
    " closed.</p></body></html>"
)


def check_bokeh() -> None:
    """Raise MissingDependencyError with the command that installs Bokeh where it is absent."""
    try:
        import bokeh  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "`raytwin explore` needs Bokeh, which is not installed: pip install 'raytwin[explore]'"
        ) from None


def tunnel_command(port: int, environment: Mapping[str, str]) -> str | None:
    """The command that brings the page to the machine one sits at; None where this is that machine (no SSH session)."""
    connection = environment.get("SSH_CONNECTION", "").split()
    if not connection:
        return None
    host = connection[2] if len(connection) == 4 else "HOST"
    with contextlib.suppress(KeyError, OSError):
        host = f"{getpass.getuser()}@{host}"
    return shlex.join(["ssh", "-N", "-L", f"{port}:{ADDRESS}:{port}", host])


def serve(
    build: Callable[[Any], None],
    *,
    listening: tuple[list[Any], int],
    browser: bool,
    told: Callable[[str, str | None], None],
) -> None:
    """Serve the page until interrupted.

    Args:
        build: fills a Bokeh document.
        listening: sockets and port, from `listen`.
        browser: open the page in the browser of this machine (not within an SSH session).
        told: called once with the page's address and the tunnel's command (None: not needed).
    """
    from bokeh.server.server import BaseServer
    from tornado.httpserver import HTTPServer
    from tornado.ioloop import IOLoop

    sockets, bound = listening
    application = _guarded_application(build, bound)
    http = HTTPServer(application)
    http.add_sockets(sockets)
    loop = IOLoop.current()
    server = BaseServer(loop, application, http)
    server.start()
    address = f"http://{ADDRESS}:{bound}/"
    tunnel = tunnel_command(bound, os.environ)
    told(address, tunnel)
    if browser and tunnel is None:
        loop.add_callback(webbrowser.open, address)
    try:
        loop.start()
    except KeyboardInterrupt:
        sys.stderr.write("closed\n")
    finally:
        with contextlib.suppress(Exception):  # what is still open is closed with the process
            server.stop()
        http.stop()


def listen(port: int | None) -> tuple[list[Any], int]:
    """Listening sockets on the loopback address, and their port.

    Args:
        port: 0 is any free one, None the default one or the next that is free.

    Raises:
        InputError: the port is taken or cannot be used.
        MissingDependencyError: Bokeh, which brings Tornado, is not installed.
    """
    check_bokeh()
    from tornado.netutil import bind_sockets

    if port is not None and not 0 <= port <= 65535:
        raise InputError("port", received=port, expected="0 to 65535; 0 is any free one")
    wanted = range(DEFAULT_PORT, DEFAULT_PORT + _PORTS_TRIED) if port is None else (port,)
    reason = ""
    for one in wanted:
        try:
            sockets = bind_sockets(one, address=ADDRESS)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            continue
        return sockets, int(sockets[0].getsockname()[1])
    raise InputError(
        "port",
        received=f"{wanted[0]} ({reason})",
        expected="a free port of this machine",
        remedy="close what uses it, or name another one",
    )


def _guarded_application(build: Callable[[Any], None], port: int) -> Any:
    """Bokeh's application behind the rules of this module's head."""
    from bokeh.application import Application
    from bokeh.application.handlers.function import FunctionHandler
    from bokeh.resources import Resources
    from bokeh.server.tornado import BokehTornado
    from tornado.web import OutputTransform, RequestHandler

    hosts = (f"{ADDRESS}:{port}", f"localhost:{port}")
    origins = tuple(f"http://{host}" for host in hosts)
    policy = (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline';"
        " img-src 'self' data: blob:; font-src 'self' data:; frame-ancestors 'none'; form-action 'none'; base-uri 'none';"
        f" connect-src 'self' {' '.join(f'ws://{host}' for host in hosts)}"
    )

    class Refusal(RequestHandler):  # type: ignore[misc, unused-ignore]
        """A plain answer in the page's place."""

        def initialize(self, status: int, text: str) -> None:
            self.refusal = (status, text)

        def prepare(self) -> None:
            status, text = self.refusal
            self.set_status(status)
            self.set_header("Content-Type", "text/html; charset=utf-8")
            self.finish(text)

    class Headers(OutputTransform):  # type: ignore[misc, unused-ignore]
        """What a browser may do with any answer: load nothing from elsewhere, show it in no other page."""

        def transform_first_chunk(
            self, status_code: int, headers: Any, chunk: bytes, finishing: bool
        ) -> tuple[int, Any, bytes]:
            headers["Content-Security-Policy"] = policy
            headers["X-Frame-Options"] = "DENY"
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            headers["Cross-Origin-Resource-Policy"] = "same-origin"
            return status_code, headers, chunk

    class Guarded(BokehTornado):  # type: ignore[misc, unused-ignore]
        """Bokeh's application, each request judged first."""

        served_at = -_OPENING_S

        def resources(self, absolute_url: str | bool | None = None) -> Resources:
            """Scripts and styles of this server, whatever the environment says."""
            return Resources(mode="server", root_url="/", path_versioner=None)

        def find_handler(self, request: Any, **words: Any) -> Any:
            refusal = self._refusal(request)
            if refusal is not None:
                status, text = refusal
                return self.get_handler_delegate(request, Refusal, {"status": status, "text": text})
            return super().find_handler(request, **words)

        def _refusal(self, request: Any) -> tuple[int, str] | None:
            origin = request.headers.get("Origin")
            if request.host.lower() not in hosts:
                return 403, f"raytwin explore answers at {origins[0]}/ and {origins[1]}/ only.\n"
            if origin is not None and origin.lower() not in origins:
                return 403, "raytwin explore answers its own page only.\n"
            if request.path == "/ws" and origin is None:
                return 403, "raytwin explore answers its own page only.\n"
            if request.method not in ("GET", "HEAD"):
                return 405, "raytwin explore is read with GET.\n"
            if request.path not in _PATHS and not request.path.startswith("/static/"):
                return 404, "There is no such page here.\n"
            connected = any(session.connection_count > 0 for session in self.get_sessions("/"))
            if request.path == "/ws":
                return (409, "The explorer is open in another window.\n") if connected else None
            if request.path == "/":
                now = time.monotonic()
                if connected or now - self.served_at < _OPENING_S:
                    return 503, _BUSY
                self.served_at = now
            return None

    return Guarded(
        {"/": Application(FunctionHandler(build))},
        extra_websocket_origins=list(hosts),
        transforms=[Headers],
        ico_path="none",
        unused_session_lifetime_milliseconds=10_000,
        check_unused_sessions_milliseconds=2_000,
        session_token_expiration=3600,
    )
