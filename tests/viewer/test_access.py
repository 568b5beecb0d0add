"""Which requests the viewer answers: names, pages, parameters and the token. Real requests to a real server."""

from __future__ import annotations

import contextlib
import gzip
import http.client
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest
from reference.scenes import for_shape, random_splats
from serving import serving

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")

import viser
from viewer_client import Client
from websockets import Headers
from websockets.exceptions import InvalidStatus

from clsplat.errors import OutputError
from clsplat.splats.splats import Splats
from clsplat.viewer import access as access_module
from clsplat.viewer import listen
from clsplat.viewer.access import Access, access_for, is_loopback, normal_name
from clsplat.viewer.initial_view import initial_view
from clsplat.viewer.server import Server
from clsplat.viewer.source import ModelSource
from clsplat.viewer.viewer import Viewer

LOCAL = access_for("127.0.0.1")
PROXIED = access_for("127.0.0.1", ["Splats.Example.org."])


def headers_of(host: str | None, origin: str | None = None, **more: str) -> Headers:
    found = Headers(**more)
    for name, value in (("Host", host), ("Origin", origin)):
        if value is not None:
            found[name] = value
    return found


def passes(access: Access, host: str | None, origin: str | None = None, path: str = "/") -> bool:
    return access.check(path, headers_of(host, origin)) is None


@pytest.mark.parametrize(
    "host",
    ["localhost:8080", "LOCALHOST:8080", "localhost.", "127.0.0.1:1", "[::1]:8080", "[0:0:0:0:0:0:0:1]", "localhost"],
)
def test_a_server_of_this_machine_answers_under_its_names(host: str) -> None:
    """Any port passes, because `ssh -L 9000:localhost:8080` makes the browser name port 9000."""
    assert passes(LOCAL, host)


@pytest.mark.parametrize(
    "host",
    [
        None,
        "",
        "evil.example",
        "evil.example:8080",
        "localhost.evil.example:8080",
        "127.0.0.1.evil.example",
        "192.168.1.5:8080",
        "[::2]:8080",
        "::1",
        "localhost:8080:8080",
        "localhost:port",
        "localhost@evil.example",
        "evil.example/localhost",
        "localhost evil.example",
        "localhost..",
    ],
)
def test_foreign_names_are_refused(host: str | None) -> None:
    """A foreign name that resolves to this machine is DNS rebinding."""
    refusal = LOCAL.check("/", headers_of(host))
    assert refusal is not None
    assert refusal.status == 403
    assert refusal.text.startswith("403: ")
    assert refusal.text.count("\n") == 1


def test_repeated_headers_are_refused() -> None:
    for name, value in (("Host", "localhost:8080"), ("Origin", "http://localhost:8080")):
        headers = headers_of("localhost:8080", "http://localhost:8080")
        assert LOCAL.check("/", headers) is None
        headers[name] = value
        assert LOCAL.check("/", headers) is not None


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:8080", "http://localhost:8080"),
        ("localhost:8080", "HTTP://LocalHost:8080"),
        ("localhost.:8080", "http://localhost:8080"),
        ("localhost:80", "http://localhost"),
        ("localhost", "http://localhost:80"),
        ("localhost", "https://localhost"),
        ("localhost:443", "https://localhost"),
        ("[::1]:8080", "http://[::1]:8080"),
        ("[0::1]:8080", "http://[::1]:8080"),
        ("localhost:9000", "http://localhost:9000"),
        ("localhost:8080", None),
    ],
)
def test_the_page_of_the_viewer_may_connect(host: str, origin: str | None) -> None:
    """No Origin: a program, which is not a browser and does not act for a foreign page."""
    assert passes(LOCAL, host, origin)


@pytest.mark.parametrize(
    "origin",
    [
        "null",
        "",
        "https://evil.example",
        "http://localhost:8081",
        "http://localhost",
        "https://localhost:8081",
        "http://127.0.0.1:8080",
        "http://localhost.evil.example:8080",
        "http://evil.example:8080",
        "http://[::1]:8080",
        "ftp://localhost:8080",
        "file://",
        "localhost:8080",
        "http://localhost:8080/",
        "http://localhost:8080@evil.example",
        "chrome-extension://localhost:8080",
    ],
)
def test_other_pages_may_not_connect(origin: str) -> None:
    assert not passes(LOCAL, "localhost:8080", origin)


def test_a_proxy_may_have_a_name() -> None:
    """Some proxies send their name as Host, others keep the address of the server."""
    assert not passes(LOCAL, "splats.example.org", "https://splats.example.org")
    assert passes(PROXIED, "splats.example.org", "https://splats.example.org")
    assert passes(PROXIED, "localhost:8080", "https://SPLATS.example.org")
    assert not passes(PROXIED, "localhost:8080", "https://other.example.org")
    assert not passes(PROXIED, "www.splats.example.org")


@pytest.mark.parametrize("name", ["websocket", "playbackPath", "%77ebsocket", "wEbsocket", "token2"])
def test_a_link_cannot_make_the_page_connect_elsewhere(name: str) -> None:
    """viser's page would run the code that another server sends, with the rights of the viewer's page."""
    assert not passes(LOCAL, "localhost:8080", path=f"/?fixedDpr=1&{name}=ws://evil.example")
    assert not passes(LOCAL, "localhost:8080", path=f"/?{name}")
    assert passes(LOCAL, "localhost:8080", path="/?fixedDpr=1.5&initialCameraFov=0.8")


def test_only_this_machine_needs_no_token() -> None:
    for host in ("127.0.0.1", "localhost", "::1", "127.8.8.8"):
        assert is_loopback(host), host
        assert not access_for(host).token
        assert access_for(host, token=True).token
    for host in ("0.0.0.0", "::", "", "192.0.2.1", "no.such.host.invalid"):
        assert not is_loopback(host), host
        assert len(access_for(host).token) >= 20
    assert access_for("0.0.0.0").token != access_for("0.0.0.0").token
    assert normal_name("[::0001]") == "::1"


def test_a_server_for_others_answers_under_addresses_and_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "Workshop.lan")
    rules = access_for("0.0.0.0")
    for host in ("192.168.1.5:8080", "[fe80::1]:8080", "localhost", "workshop.lan", "workshop.local:8080"):
        assert not passes(rules, host), host
        assert rules.check(rules.query, headers_of(host, Upgrade="websocket")) is None, host
    foreign = headers_of("192.168.1.5:8080", "http://evil.example:8080", Upgrade="websocket")
    for headers in (headers_of("evil.example:8080", Upgrade="websocket"), foreign):
        refusal = rules.check(rules.query, headers)
        assert refusal is not None
        assert refusal.status == 403


def passes_with(rules: Access, path: str, cookie: str = "") -> bool:
    return rules.check(path, headers_of("192.0.2.1:8080", Cookie=cookie, Upgrade="websocket")) is None


def test_the_token_is_in_the_address_or_in_a_cookie(monkeypatch: pytest.MonkeyPatch) -> None:
    rules, compared = access_for("0.0.0.0"), list[bytes]()
    genuine = access_module.hmac.compare_digest

    def compare(value: bytes, secret: bytes) -> bool:
        compared.append(value)
        return genuine(value, secret)

    monkeypatch.setattr(access_module.hmac, "compare_digest", compare)
    right, cookie = rules.query, f"a=b; {rules.cookie}={rules.token}; c=d"
    assert passes_with(rules, right)
    assert passes_with(rules, "/", cookie)
    assert passes_with(rules, "/?token=wrong", cookie)
    for path in (
        "/",
        "/?token=",
        "/?token=wrong",
        f"{right}x",
        right[:-1],
        f"/?fixedDpr={rules.token}",
        "/?token=%ff%00é",
    ):
        assert not passes_with(rules, path), path
    for wrong in (f"{rules.cookie}=", f"other={rules.token}", f"{rules.cookie}={rules.token}x"):
        assert not passes_with(rules, "/", wrong), wrong
    assert len(compared) >= 10, "in constant time"


def test_the_first_page_turns_the_token_into_a_cookie() -> None:
    rules = access_for("0.0.0.0")
    answer = rules.check(f"{rules.query}&fixedDpr=2", headers_of("192.0.2.1:8080"))
    assert answer is not None
    assert answer.status == 303
    assert answer.headers["Location"] == "./?fixedDpr=2"
    assert answer.headers["Set-Cookie"] == f"{rules.cookie}={rules.token}; Path=/; HttpOnly; SameSite=Lax"
    assert rules.token not in rules.cookie + answer.text


# --- a real server --------------------------------------------------------------------------


class Served:
    """A server with a model, and how often its pause button was pressed."""

    def __init__(self, **options: object) -> None:
        splats = Splats("gaussian", for_shape(random_splats(3, 20, 3, np.float32), "gaussian"))
        self.viewer = Viewer(ModelSource(splats))
        self.server = Server(self.viewer, initial_view(splats.mean, []), port=0, **options)  # type: ignore[arg-type]
        self.pressed = 0
        self.server.add_training(self.press)
        self._open = ExitStack()
        self._open.enter_context(serving(self.viewer, self.server))

    def press(self) -> None:
        self.pressed += 1

    def close(self) -> None:
        self._open.close()

    def get(self, path: str = "/", **headers: str) -> http.client.HTTPResponse:
        """Return the answer to a request, with its `body`."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=10)
        connection.putrequest("GET", path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        response.body = response.read()  # type: ignore[attr-defined]
        connection.close()
        return response


@pytest.fixture(scope="module")
def open_servers() -> Iterator[Callable[..., Served]]:
    found: dict[str, Served] = {}

    def served(**options: object) -> Served:
        key = json.dumps(options)
        if key not in found:
            found[key] = Served(**options)
        return found[key]

    yield served
    for server in found.values():
        server.close()


def refused(port: int, **how: str) -> bool:
    """Whether a websocket is refused with 403 and one line."""
    with pytest.raises(InvalidStatus) as caught:
        Client(port, **how)
    body = caught.value.response.body
    return caught.value.response.status_code == 403 and bool(body) and body.count(b"\n") == 1


def test_foreign_pages_get_no_websocket(
    open_servers: Callable[..., Served], capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    local = open_servers()
    port = local.server.port
    for how in (
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": f"http://localhost:{port + 1}"},
        {"host": f"evil.example:{port}"},
        {"host": f"evil.example:{port}", "origin": f"http://evil.example:{port}"},
    ):
        assert refused(port, **how), how
    assert not local.viewer.count
    assert capfd.readouterr() == ("", "")
    assert not caplog.records
    with Client(port, origin=f"http://127.0.0.1:{port}") as client:
        client.look()
        client.picture()
        client.set("Pause", True)
        client.drain(0.2)
    assert local.pressed == 1


def test_foreign_names_get_no_page(open_servers: Callable[..., Served]) -> None:
    local = open_servers()
    answer = local.get(Host="evil.example")
    assert answer.status == 403
    assert answer.headers["Content-Type"].startswith("text/plain")
    assert answer.body.startswith(b"403: this name is not one of the viewer's")  # type: ignore[attr-defined]
    assert local.get("/?websocket=ws://evil.example").status == 403
    assert local.get("/nothing").status == 404
    page = local.get()
    assert page.status == 200
    policy = page.headers["Content-Security-Policy"]
    assert f"connect-src 'self' ws://127.0.0.1:{local.server.port} " in policy
    assert "frame-ancestors 'self'" in policy
    assert page.body.count(b"'fixedDpr'") == 2  # type: ignore[attr-defined]
    packed = local.get(**{"Accept-Encoding": "gzip"})
    assert packed.headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(packed.body) == page.body  # type: ignore[attr-defined]


def test_a_server_for_others_needs_its_token(open_servers: Callable[..., Served]) -> None:
    shared = open_servers(host="0.0.0.0")
    port, access = shared.server.port, shared.server.access
    assert shared.server.url == f"http://localhost:{port}/?token={access.token}"
    assert len(shared.server.urls) == 2
    assert refused(port)
    assert refused(port, path="/?token=wrong")
    assert shared.get().status == 403
    assert shared.get("/nothing").status == 403
    first = shared.get(access.query)
    assert first.status == 303
    cookie = first.headers["Set-Cookie"].partition(";")[0]
    assert shared.get(Cookie=cookie).status == 200
    assert shared.get("/nothing", Cookie=cookie).status == 404
    with Client(port, path=access.query) as client:
        client.look()
        client.picture()


def test_a_viser_that_cannot_be_guarded_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listen, "_VISER", "elsewhere")
    with pytest.raises(OutputError, match=f"viser {viser.__version__}: its server cannot be guarded"):
        listen.open_server("127.0.0.1", 0, LOCAL)


def test_other_servers_of_the_process_are_not_guarded() -> None:
    import websockets.asyncio.server as websocket_server

    genuine = websocket_server.serve
    with contextlib.suppress(OutputError):
        listen.open_server("256.1.1.1", 0, LOCAL)
    with listen._guarded(LOCAL) as guards:
        assert websocket_server.serve is not genuine
    assert websocket_server.serve is genuine
    assert not guards
