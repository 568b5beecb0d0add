"""Mutations: single wrong changes of the sources, and whether the tests notice them (benchmarks/mutations.py).

A table (benchmarks/mutation_tables/*.toml) lists files, for each the tests that are likely to notice a change, and the
changes: the text before and after, and what the change means. One change at a time is made in a scratch copy of the
repository, and the tests run there. The working tree never changes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLES = ROOT / "benchmarks" / "mutation_tables"
INSTALLED = {"clsplat": "clsplat", "clsplat_cl": "cl", "clsplat_cli": "cli", "clsplat_blender": "blender"}
TIMEOUT = 600.0  # seconds of one call of pytest; a change that makes the tests hang is noticed, too
# Libraries that tests load. Those with drivers and threads of their own (pyopencl, pycolmap) do not survive a fork.
LIBRARIES = (
    "numpy",
    "PIL.Image",
    "scipy.optimize",
    "scipy.spatial.transform",
    "scipy.special",
    "scipy.integrate",
    "scipy.interpolate",
    "scipy.ndimage",
    "hypothesis.extra.numpy",
    "click.testing",
    "pytest",
    "xdist",
)
SCHEDULE = "1x16x16"  # of tests with a changed kernel
CAUGHT, SURVIVED, EQUIVALENT = "caught", "survived", "equivalent"
# Tests of a package, for a change that the named tests do not notice.
WIDER = {"cl": ("tests/rendering", "tests/training"), "cli": ("tests/cli",), "blender": ("tests/blender",)}
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", re.M)


@dataclass(frozen=True)
class Mutation:
    """One change of a source file.

    Parameters
    ----------
    file : path in the repository.
    old, new : the text before and after. `old` occurs once, or the `nth` occurrence is changed.
    means : what is wrong after the change.
    tests : test files, each possibly followed by -k and an expression of pytest.
    equivalent : the reason why no test can notice the change; empty for a real mutation.
    """

    id: str
    file: str
    old: str
    new: str
    means: str
    tests: tuple[str, ...]
    nth: int | None = None
    equivalent: str = ""

    @property
    def package(self) -> str:
        """Name of the package: cl, cli, or the part of clsplat."""
        parts = self.file.split("/")
        return parts[1] if parts[0] == "clsplat" and len(parts) > 2 else parts[0]

    @property
    def digest(self) -> str:
        """Hash of the change, so that a stored result belongs to it."""
        return hashlib.sha256(repr((self.file, self.old, self.new, self.nth)).encode()).hexdigest()[:16]

    def applied(self, text: str) -> str:
        """Return the changed text of the file.

        Raises
        ------
        ValueError : the old text does not occur as the table says.
        """
        places = [match.start() for match in re.finditer(re.escape(self.old), text)]
        if self.nth is None and len(places) != 1:
            raise ValueError(f"{self.id}: {self.file} has the old text {len(places)} times, expected once")
        if len(places) < (self.nth or 1):
            raise ValueError(f"{self.id}: {self.file} has the old text {len(places)} times, expected {self.nth}")
        at = places[(self.nth or 1) - 1]
        return text[:at] + self.new + text[at + len(self.old) :]


@dataclass
class Result:
    """Outcome of one mutation: the test that noticed it, how long that took, and the tests that did not notice it."""

    id: str
    package: str
    outcome: str
    by: str = ""
    seconds: float = 0.0
    passed: list[str] = field(default_factory=list)
    digest: str = ""


def read_tables(folder: Path = TABLES) -> list[Mutation]:
    """Return all mutations of the tables, in the order of the files."""
    found = []
    for table in sorted(folder.glob("*.toml")):
        for entry in tomllib.loads(table.read_text(encoding="utf-8"))["file"]:
            for change in entry["change"]:
                tests = tuple(f"tests/{test}" for test in change.pop("tests", entry["tests"]))
                found.append(Mutation(file=entry["path"], tests=tests, **change))
    return found


def faults_of(mutations: Sequence[Mutation], root: Path = ROOT) -> list[str]:
    """Return what is wrong with a table: changes that do not apply, names that occur twice, tests that do not exist."""
    faults, seen = [], set()
    for mutation in mutations:
        if mutation.id in seen:
            faults.append(f"{mutation.id}: the name occurs twice")
        seen.add(mutation.id)
        path = root / mutation.file
        if not path.is_file():
            faults.append(f"{mutation.id}: {mutation.file} does not exist")
            continue
        try:
            mutation.applied(path.read_text(encoding="utf-8"))
        except ValueError as error:
            faults.append(str(error))
        if mutation.old == mutation.new:
            faults.append(f"{mutation.id}: changes nothing")
        missing = [test for test in mutation.tests if not (root / test.split(" -k ")[0]).exists()]
        faults += [f"{mutation.id}: {test} does not exist" for test in missing]
        if not mutation.tests and not mutation.equivalent:
            faults.append(f"{mutation.id}: names no tests")
    return faults


class ScratchCopy:
    """A copy of the repository's files in a folder, in which one file at a time is changed.

    Parameters
    ----------
    folder : an empty folder.
    pytest : runs the tests.
    """

    def __init__(self, folder: Path, pytest: WarmPytest, root: Path = ROOT) -> None:
        self.tree, self.pytest = folder / "tree", pytest
        names = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(names, cwd=root, capture_output=True, check=True).stdout.decode().split("\0")
        for name in listed:
            if (root / name).is_file():
                (self.tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(root / name, self.tree / name)
        # Imports find the copy first: the installed package may be the working tree.
        packages = folder / "packages"
        packages.mkdir()
        for name, source in INSTALLED.items():
            (packages / name).symlink_to(self.tree / source)
        self.environment = os.environ | {"PYTHONPATH": str(packages), "PYTHONDONTWRITEBYTECODE": "1"}
        self.environment.setdefault("CLSPLAT_DATA", str(root.parent / "shared" / "data"))
        self._keep_kernels(folder / "kernels")

    def _keep_kernels(self, folder: Path) -> None:
        """Give PoCL a cache in the folder, which starts as a copy of the user's one."""
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pocl" / "kcache"
        folder.mkdir()
        if cache.is_dir() and (self.tree / "cl").is_dir():
            with suppress(shutil.Error):  # another process has renamed a file meanwhile
                shutil.copytree(cache, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("tempfile*"))
        self.environment["POCL_CACHE_DIR"] = str(folder)

    @contextmanager
    def changed(self, mutation: Mutation) -> Iterator[None]:
        """Change the file of the mutation for a block of code."""
        path = self.tree / mutation.file
        text = path.read_text(encoding="utf-8")
        path.write_text(mutation.applied(text), encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(text, encoding="utf-8")

    def failure(self, arguments: Sequence[str], kernels: bool = False) -> str:
        """Run pytest with these arguments and return the first test that fails; an empty text if all pass.

        Parameters
        ----------
        kernels : whether a kernel is changed. The schedule is then given, because measuring it would build all
            kernels for each candidate.

        Raises
        ------
        ValueError : the arguments select no test.
        """
        options = ["-q", "-x", "-n", "0", "--tb=no", "-rfE", "-p", "no:cacheprovider"]
        environment = {"CLSPLAT_SCHEDULE": SCHEDULE, **self.environment} if kernels else self.environment
        shown = " ".join(arguments)
        code, output = self.pytest.run([*options, *arguments], self.tree, environment)
        if code is None:
            return f"{shown}: no end within {self.pytest.timeout:g} s"
        if code == 0:
            return ""
        failed = _FAILED.search(output)
        if failed:
            return failed[1]
        if code == 5:
            raise ValueError(f"{shown}: selects no test")
        return f"{shown}: ended with {code}"


class WarmPytest:
    """Runs of pytest in forks of a process that has loaded the libraries (warm_pytest.py).

    Parameters
    ----------
    folder : place of the output of a run.
    prefix : a command whose process lives as long as a run, such as one that waits for its turn.
    timeout : seconds of a run.
    libraries : names of the libraries.
    """

    def __init__(
        self,
        folder: Path,
        prefix: Sequence[str] = (),
        timeout: float = TIMEOUT,
        libraries: Sequence[str] = LIBRARIES,
    ) -> None:
        self.output, self.prefix, self.timeout, self.libraries = folder / "output", tuple(prefix), timeout, libraries
        self._server: subprocess.Popen[str] | None = None

    def run(self, arguments: list[str], folder: Path, environment: Mapping[str, str]) -> tuple[int | None, str]:
        """Return the exit code of a run, or None if it did not end in time, and its output."""
        server = self._started()
        assert server.stdin is not None
        with self._turn():
            request = {"arguments": arguments, "folder": str(folder), "environment": dict(environment)}
            server.stdin.write(json.dumps(request | {"output": str(self.output)}) + "\n")
            server.stdin.flush()
            process, late = int(self._answer(server)), threading.Event()
            timer = threading.Timer(self.timeout, lambda: (late.set(), _kill_group(process)))
            timer.start()
            code = int(self._answer(server))
            timer.cancel()
        return None if late.is_set() else code, self.output.read_text(errors="replace", encoding="utf-8")

    def close(self) -> None:
        """End the process."""
        if self._server is not None:
            self._server.communicate()

    def _started(self) -> subprocess.Popen[str]:
        if self._server is None:
            command = [sys.executable, str(Path(__file__).with_name("warm_pytest.py")), *self.libraries]
            self._server = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8"
            )
            self._answer(self._server)
        return self._server

    @staticmethod
    def _answer(server: subprocess.Popen[str]) -> str:
        assert server.stdout is not None
        return server.stdout.readline().strip()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Keep the process of the prefix alive during a block of code."""
        if not self.prefix:
            yield
            return
        waiting = subprocess.Popen(
            [*self.prefix, "sh", "-c", "echo; read end"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )
        assert waiting.stdout is not None
        waiting.stdout.readline()
        try:
            yield
        finally:
            waiting.communicate()


def _kill_group(process: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)


def calls_of(tests: Sequence[str]) -> list[list[str]]:
    """Return the arguments of each call of pytest: one for each entry with -k, and a last one for all whole files."""
    calls, whole = [], []
    for test in tests:
        files, chosen, names = test.partition(" -k ")
        if chosen:
            calls.append([files, "-k", names])
        else:
            whole.append(test)
    return [*calls, whole] if whole else calls


def wider_tests(mutation: Mutation, root: Path = ROOT) -> list[str]:
    """Return the test files of a mutation's package that the mutation does not name as a whole."""
    folders = WIDER.get(mutation.package, (f"tests/{mutation.package}",))
    files = [file.relative_to(root).as_posix() for folder in folders for file in (root / folder).glob("test_*.py")]
    return sorted(set(files) - set(mutation.tests))


class Laboratory:
    """Mutations of one scratch copy. Each failure is confirmed: the same test must pass without the mutation.

    Parameters
    ----------
    wide : whether the other tests of the package run if the named tests pass.
    every : whether all default tests run after that.
    """

    def __init__(self, copy: ScratchCopy, wide: bool = True, every: bool = False) -> None:
        self.copy, self.wide, self.every = copy, wide, every
        self._sound: dict[tuple[str, ...], bool] = {}

    def run(self, mutation: Mutation) -> Result:
        """Apply a mutation and run its tests until one fails.

        Raises
        ------
        ValueError : the mutation does not apply, selects no test, or its failing test also fails without it.
        """
        start = time.monotonic()
        result = Result(mutation.id, mutation.package, EQUIVALENT, mutation.equivalent, digest=mutation.digest)
        if mutation.equivalent:
            return result
        calls = calls_of(mutation.tests)
        if self.wide and (more := wider_tests(mutation, self.copy.tree)):
            calls.append(more)
        if self.every:
            calls.append(["tests"])
        kernels = mutation.file.startswith("cl/")
        with self.copy.changed(mutation):
            for arguments in calls:
                result.by = self.copy.failure(arguments, kernels)
                if result.by:
                    break
                result.passed.append(" ".join(arguments))
        result.outcome = CAUGHT if result.by else SURVIVED
        result.seconds = round(time.monotonic() - start, 1)
        # A crash or a hang names no test: then the whole call must be sound.
        confirm = [result.by] if "::" in result.by else arguments
        if result.by and not self._is_sound(confirm, kernels):
            raise ValueError(f"{mutation.id}: {result.by} fails without the mutation, too")
        return result

    def _is_sound(self, arguments: list[str], kernels: bool) -> bool:
        """Whether tests pass without a mutation."""
        key = (*arguments, str(kernels))
        if key not in self._sound:
            self._sound[key] = not self.copy.failure(arguments, kernels)
        return self._sound[key]


def share_caught(results: Sequence[Result]) -> tuple[int, int]:
    """Return how many mutations were caught, and how many could be: all but the equivalent ones."""
    real = [result for result in results if result.outcome != EQUIVALENT]
    return sum(result.outcome == CAUGHT for result in real), len(real)
