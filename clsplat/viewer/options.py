"""Options of a viewer's server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ServerOptions:
    """The address of a viewer.

    Parameters
    ----------
    host : address to listen at; 0.0.0.0 lets every machine that reaches this one look.
    port : port to listen at; 0 takes any free one.
    names : more host names under which browsers reach the viewer, for a proxy.
    token : require the token of the printed address also on this machine. Other machines always need it.
    paths : folder for recorded camera paths and cropped models; None only lets browsers download them.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    token: bool = False
    paths: Path | None = None
