"""The status line of a browser: messages stay, and the text of the last frame follows."""

from __future__ import annotations

import threading
import time

import pytest

from clsplat.viewer import status_line
from clsplat.viewer.status_line import StatusLine


class Shown:
    """The texts that a line has shown."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self._changed = threading.Condition()

    def __call__(self, text: str) -> None:
        with self._changed:
            self.texts.append(text)
            self._changed.notify_all()

    def wait(self, n: int, timeout: float = 30.0) -> list[str]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.texts) >= n, timeout), self.texts
            return list(self.texts)


def test_frames_are_described_at_once_if_there_is_no_message() -> None:
    line = StatusLine(shown := Shown())
    line.describe("one")
    line.describe("two")
    assert shown.texts == ["one", "two"]


def test_the_last_frame_is_described_once_a_message_has_been_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_line, "READING_TIME", 2.0)
    line, start = StatusLine(shown := Shown()), time.monotonic()
    line.say("a message")
    line.describe("one")
    line.describe("two")
    assert shown.wait(2) == ["a message", "two"]
    assert time.monotonic() - start >= 2.0


def test_each_message_stays_for_its_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_line, "READING_TIME", 3.0)
    line = StatusLine(shown := Shown())
    line.say("first")
    line.describe("one")
    time.sleep(0.5)
    line.say("second")
    start = time.monotonic()
    line.describe("two")
    assert shown.wait(3) == ["first", "second", "two"]
    assert time.monotonic() - start >= 2.98


def test_a_message_ends_with_its_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_line, "READING_TIME", 600.0)
    line = StatusLine(shown := Shown())
    line.say("the file is truncated; the previous model stays")
    line.describe("100 splats")
    line.expire()
    line.describe("50 splats")
    assert shown.texts == ["the file is truncated; the previous model stays", "50 splats"]
    line.close()


def test_nothing_is_shown_after_the_page_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_line, "READING_TIME", 1.0)
    line = StatusLine(shown := Shown())
    line.say("a message")
    line.describe("one")
    line.close()
    time.sleep(1.5)
    assert shown.texts == ["a message"]
