"""Which requests a viewer answers: Host, Origin, parameters of the address, and a token if others reach the server.

A browser sends requests of every page that its user has open. Three headers show whether a request is one of the
viewer's page. `Host` is the name that the browser looked up: a foreign name that resolves to this machine (DNS
rebinding) is refused. `Origin` is the page that opens a websocket: only the viewer's page may. The cookie holds the
token of the printed address.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol
from urllib.parse import parse_qsl, urlencode

_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[^\s:@/\\?#\[\]]+)(?::([0-9]{1,5}))?", re.I | re.A)
_DEFAULT_PORTS = {"http": 80, "https": 443}
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
# Parameters of the page that stay harmless in a link of a stranger. Others make viser's page connect elsewhere.
_PARAMETER = re.compile(r"token|fixedDpr|darkMode|showStats|initialCamera\w*", re.A)
_TOKEN_BYTES = 16


class Headers(Protocol):
    """Headers of a request; names are found in any case."""

    def get_all(self, key: str, /) -> list[str]: ...


@dataclass(frozen=True)
class Refusal:
    """An answer other than the page. `headers` may set a cookie and redirect."""

    status: int
    text: str
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Access:
    """The rules of one server.

    Attributes
    ----------
    names : host names and addresses under which it answers, as `normal_name` returns them.
    trusted : names whose pages may open a websocket, whatever the Host header says (a proxy may rewrite it).
    any_address : whether it also answers under every IP address. A rebound name is never an address.
    token : secret of the printed address; "" if none is needed.
    """

    names: frozenset[str]
    trusted: frozenset[str] = frozenset()
    any_address: bool = False
    token: str = ""

    def check(self, path: str, headers: Headers) -> Refusal | None:
        """Return the answer to a request that does not get the page or a websocket, or None if it does.

        Parameters
        ----------
        path : of the request, with its query.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = _authority(hosts[0]) if len(hosts) == 1 else None
        if host is None or not self._answers_as(host[0]):
            return _forbidden("this name is not one of the viewer's: open the printed address, or give --allow-host")
        # Programs other than browsers send no Origin. They do not run at the wish of a foreign page.
        if len(origins) > 1 or (origins and not self._same_origin(origins[0], host)):
            return _forbidden("another page may not use the viewer")
        query = parse_qsl(path.partition("?")[2], keep_blank_values=True)
        unknown = next((name for name, _ in query if not _PARAMETER.fullmatch(name)), None)
        if unknown is not None:
            return _forbidden("the address has a parameter that the viewer does not know")
        return self._check_token(query, headers) if self.token else None

    @property
    def query(self) -> str:
        """The token as the end of the printed address."""
        return f"/?{urlencode({'token': self.token})}" if self.token else ""

    @property
    def cookie(self) -> str:
        """Name of the cookie. Cookies do not know ports, so that two viewers of a machine need two names."""
        return f"clsplat-{hmac.new(self.token.encode(), b'name', 'sha256').hexdigest()[:8]}"

    def _answers_as(self, name: str) -> bool:
        return name in self.names or name in self.trusted or (self.any_address and _address(name) is not None)

    def _same_origin(self, origin: str, host: tuple[str, int | None]) -> bool:
        scheme, separator, rest = origin.lower().partition("://")
        page = _authority(rest)
        if not separator or scheme not in _DEFAULT_PORTS or page is None:  # also the origin "null" of a local file
            return False
        if page[0] in self.trusted:
            return True
        default = _DEFAULT_PORTS[scheme]
        return page[0] == host[0] and (page[1] or default) == (host[1] or default)

    def _check_token(self, query: Sequence[tuple[str, str]], headers: Headers) -> Refusal | None:
        tokens = [value for name, value in query if name == "token"]
        cookies = (part.strip().partition("=") for line in headers.get_all("Cookie") for part in line.split(";"))
        if any(_equal(value, self.token) for name, _, value in cookies if name == self.cookie):
            return None
        if not any(_equal(value, self.token) for value in tokens):
            return _forbidden("the token is missing or wrong: open the whole address that the command printed")
        if headers.get_all("Upgrade"):  # a program's websocket, which does not keep cookies
            return None
        # The redirect takes the token out of the browser's address bar and history.
        rest = urlencode([(name, value) for name, value in query if name != "token"])
        cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
        return Refusal(303, "", {"Location": f"./?{rest}" if rest else "./", "Set-Cookie": cookie})


def access_for(host: str, names: Sequence[str] = (), token: bool = False) -> Access:
    """Return the rules for a server.

    Parameters
    ----------
    host : address to listen at. names : more names under which browsers reach the server.
    token : require a token although only this machine reaches the server.
    """
    trusted = frozenset(normal_name(name) for name in names)
    known = {*_LOOPBACK, normal_name(host)}
    if is_loopback(host):
        return Access(frozenset(known), trusted, token=secrets.token_urlsafe(_TOKEN_BYTES) if token else "")
    machine = normal_name(socket.gethostname())
    known |= {machine, f"{machine.partition('.')[0]}.local"}
    return Access(frozenset(known), trusted, True, secrets.token_urlsafe(_TOKEN_BYTES))


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens at `host`; False if the name is unknown."""
    if not host:
        return False
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):
        return False
    return all(ipaddress.ip_address(address.partition("%")[0]).is_loopback for address in found)


def normal_name(name: str) -> str:
    """Return a host name in lower case without its final dot, and an address in its shortest form."""
    name = name.strip().lower()
    name = name[1:-1] if name.startswith("[") and name.endswith("]") else name.removesuffix(".")
    return _address(name) or name


def _address(name: str) -> str | None:
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return None


def _authority(text: str) -> tuple[str, int | None] | None:
    """Return (name, port) of "name:port"; None if it is something else."""
    match = _AUTHORITY.fullmatch(text)
    if match is None:
        return None
    return normal_name(match[1]), int(match[2]) if match[2] else None


def _equal(value: str, secret: str) -> bool:
    """Whether two texts are equal, in a time that does not tell how much of them is."""
    return hmac.compare_digest(value.encode("utf-8", "surrogatepass"), secret.encode())


def _forbidden(reason: str) -> Refusal:
    return Refusal(403, f"403: {reason}\n")
