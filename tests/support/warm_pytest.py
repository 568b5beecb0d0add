"""A process that has loaded the libraries and forks for each run of pytest, so that a run does not load them again.

The arguments are the names of the libraries. Each line of the standard input is a run in JSON: arguments, environment
and the file for the output. The answers are
the process of the run, and its exit code when it has ended. mutating.py is the other side.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys


def run(request: dict) -> None:
    """Run pytest in this process and end it."""
    output = os.open(request["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background process ignores it
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    sys.path[0:0] = [os.environ["PYTHONPATH"], request["folder"]]
    code = 70
    try:
        code = int(importlib.import_module("pytest").main(request["arguments"]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def main() -> None:
    sys.path.pop(0)  # the folder of this file: tests have another copy of their helpers
    for name in sys.argv[1:]:
        importlib.import_module(name)
    print("ready", flush=True)
    for line in sys.stdin:
        process = os.fork()
        if not process:
            run(json.loads(line))
        print(process, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
