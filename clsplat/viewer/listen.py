"""Opening of viser's server at an address, with a check of every request."""

from __future__ import annotations

import contextlib
import gzip
import http
import io
import logging
import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server as websocket_server
from websockets import Headers
from websockets.http11 import Request, Response

from ..errors import OutputError
from .access import Access

_VISER = "viser.infra"  # the package whose server is guarded
_replacing = threading.Lock()
# viser's page lowers its resolution on a slow machine while it draws, and a still page never draws enough to raise it
# again. A fixed resolution is one of its parameters of the address.
_FULL_SIZE = (
    b"<script>{const a=new URL(location.href);if(!a.searchParams.has('fixedDpr')){"
    b"a.searchParams.set('fixedDpr',devicePixelRatio);history.replaceState(null,'',a)}}</script>"
)


class Private(viser.ViserServer):
    """A viser server without the relay that would make the page public at the request of a browser."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def open_server(host: str, port: int, access: Access) -> viser.ViserServer:
    """Open a server at exactly this address; viser alone would take the next free port, and answer everybody.

    Raises
    ------
    OutputError : the server cannot listen on the address.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            # On Windows SO_REUSEADDR takes a port from the program that listens on it.
            option: int = getattr(socket, "SO_EXCLUSIVEADDRUSE", socket.SO_REUSEADDR)
            probe.setsockopt(socket.SOL_SOCKET, option, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise _refusal(host, port, getattr(error, "strerror", None) or str(error)) from None
    # Broken connections log noise; the panel shows what matters.
    for name in ("websockets", "websockets.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    for message in ("Queued a .* on a closed connection", r"\[viser\]"):
        warnings.filterwarnings("ignore", message=message)
    with contextlib.redirect_stdout(io.StringIO()), _guarded(access) as guards:  # viser prints a greeting
        server = Private(host, port, verbose=False)
    if not guards:
        server.stop()
        raise OutputError(f"viser {viser.__version__}: its server cannot be guarded; pip install 'viser==1.1.1'")
    if port and server.get_port() != port:  # another program took the port in between
        server.stop()
        raise _refusal(host, port, "taken by another program")
    # A malformed message of a browser is dropped without a traceback.
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, lambda *_: None)
    return server


@contextlib.contextmanager
def _guarded(access: Access) -> Iterator[list[Guard]]:
    """Guard the servers that viser starts in this context, and return their guards.

    viser offers no way to check requests, so that the function with which it starts a server is replaced meanwhile.
    """
    guards: list[Guard] = []
    start = websocket_server.serve

    def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        if getattr(handler, "__module__", "").startswith(_VISER):
            process_request = Guard(access, process_request)
            guards.append(process_request)
        return start(handler, *args, process_request=process_request, **options)

    with _replacing:
        websocket_server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield guards
        finally:
            websocket_server.serve = start  # type: ignore[misc]


class Guard:
    """The first look at each request: an answer from `access`, or else what viser answers.

    Parameters
    ----------
    pages : viser's function, which returns None for a websocket.
    """

    def __init__(self, access: Access, pages: Callable[[Any, Request], Response | None]) -> None:
        self._access, self._pages = access, pages
        self._bodies: dict[bytes, bytes] = {}

    def __call__(self, connection: Any, request: Request) -> Response | None:
        refusal = self._access.check(request.path, request.headers)
        if refusal is not None:
            status = http.HTTPStatus(refusal.status)
            headers = {"Content-Type": "text/plain; charset=utf-8", "Cache-Control": "no-store"} | refusal.headers
            return _response(status, headers, refusal.text.encode())
        response = self._pages(connection, request)
        if response is None or response.status_code != http.HTTPStatus.OK:
            return response
        host = request.headers["Host"]  # `access` has checked its form
        headers = dict(response.headers.raw_items()) | {
            # The page talks to this server alone, and no foreign page shows it in a frame to catch clicks.
            "Content-Security-Policy": f"connect-src 'self' ws://{host} wss://{host} data: blob:; "
            "frame-ancestors 'self'; base-uri 'none'; object-src 'none'; form-action 'none'",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        body = bytes(response.body or b"")
        if headers.get("Content-Type", "").startswith("text/html"):
            body = self._at_full_size(body, headers.get("Content-Encoding") == "gzip")
        return _response(http.HTTPStatus.OK, headers, body)

    def _at_full_size(self, page: bytes, packed: bool) -> bytes:
        """Return the page with the script that fixes its resolution. Each page is packed once."""
        if page not in self._bodies:
            html = (gzip.decompress(page) if packed else page).replace(b"<head>", b"<head>" + _FULL_SIZE, 1)
            self._bodies[page] = gzip.compress(html) if packed else html
        return self._bodies[page]


def _response(status: http.HTTPStatus, headers: dict[str, str], body: bytes) -> Response:
    return Response(status, status.phrase, Headers(headers | {"Content-Length": str(len(body))}), body)


def _refusal(host: str, port: int, reason: str) -> OutputError:
    return OutputError(f"{host}:{port}: cannot listen on this address ({reason}); choose another --port or --host")
