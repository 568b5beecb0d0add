"""Addresses of clusters, and scheduler files."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from clsplat.cluster.address import ClusterAddress
from clsplat.cluster.dask import scheduler_address
from clsplat.errors import InputError


@pytest.mark.parametrize(("text", "workers"), [("local", None), ("local:1", 1), ("local:16", 16)])
def test_local_workers(text: str, workers: int | None) -> None:
    place = ClusterAddress.parse(text)
    assert (place.is_local, place.workers, place.is_file) == (True, workers, False)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("tcp://host:8786", "tcp://host:8786"),
        ("tls://10.0.0.1:8786", "tls://10.0.0.1:8786"),
        ("host:8786", "tcp://host:8786"),
    ],
)
def test_addresses_of_schedulers(text: str, address: str) -> None:
    place = ClusterAddress.parse(text)
    assert not place.is_local
    assert scheduler_address(place) == address


@pytest.mark.parametrize(
    "text", ["", "host", "local:0", "local:x", "local:-1", "local:99999", "host:x", "http://host:80", "a b:1", "tcp://"]
)
def test_what_is_not_an_address_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^cluster "):
        ClusterAddress.parse(text)


def test_a_scheduler_file_has_the_address(tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"type": "Scheduler", "address": "tcp://10.0.0.1:8786", "workers": {}}))
    assert scheduler_address(ClusterAddress.parse(str(file))) == "tcp://10.0.0.1:8786"


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"address": 3}', "[" * 100_000, "\x00"])
def test_a_file_without_an_address_is_one_line(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "scheduler.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(InputError, match=r"scheduler\.json: .*dask scheduler --scheduler-file"):
        scheduler_address(ClusterAddress.parse(str(file)))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_pipe_is_no_scheduler_file(tmp_path: Path) -> None:
    """Nobody may ever write into it."""
    file = tmp_path / "scheduler.json"
    os.mkfifo(file)
    with pytest.raises(InputError, match=r"scheduler\.json: not a scheduler file"):
        scheduler_address(ClusterAddress.parse(str(file)))
