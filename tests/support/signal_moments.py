"""A program that sends itself a signal at a chosen moment of its start, and a check of how it ends."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence

# A moment is the number of audit events so far: imports, compiled code, opened files and others. Unlike a time, it does
# not depend on the load of the machine. The count begins with the handlers of clsplat_cli.start.
PROGRAM = """
import os, sys
number, moment, events = int(sys.argv[1]), int(sys.argv[2]), 0

def count(event, args):
    global events
    events += 1
    if events == moment:
        os.kill(os.getpid(), number)

from clsplat_cli import start
end = start._end_at_signals

def begin():
    end()
    start._end_at_signals = end
    sys.addaudithook(count)

start._end_at_signals = begin
sys.argv = ["clsplat", *sys.argv[3:]]
try:
    start.main()
finally:
    if not moment:
        print(events, file=sys.stderr)
"""


def run_until(number: int, moment: int, args: Sequence[object]) -> subprocess.CompletedProcess[str]:
    """Run `clsplat ARGS` and send the signal at a moment. Moment 0 sends none and prints the number of moments."""
    command = [sys.executable, "-c", PROGRAM, str(number), str(moment), *map(str, args)]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=120,
        stdin=subprocess.DEVNULL,
        preexec_fn=heed_ctrl_c,
        encoding="utf-8",
    )


def count_moments(args: Sequence[object]) -> int:
    """Return the number of moments of a whole run."""
    return int(run_until(0, 0, args).stderr.splitlines()[-1])


def heed_ctrl_c() -> None:
    """Undo that shells make background jobs ignore SIGINT, which child processes inherit."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def fault_of(done: subprocess.CompletedProcess[str], number: int) -> str:
    """Return what is wrong with the end of a program after a signal; "" if nothing is."""
    if done.returncode != 128 + number:
        return f"exit code {done.returncode}: {done.stderr}"
    words = ("Traceback", "Exception ignored", 'File "', "stack trace")
    return done.stderr if any(word in done.stderr for word in words) else ""
