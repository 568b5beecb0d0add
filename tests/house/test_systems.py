"""The sources run on Windows and macOS, as far as a program can read it from their text.

Nobody has run them there. tests/cli/test_other_systems.py runs commands without what only POSIX has.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("clsplat", "cli", "blender")
SOURCES = [
    path
    for folder in (*PRODUCT, "docs", "benchmarks", "tests/support")
    for path in sorted((ROOT / folder).rglob("*.py"))
]

# Modules and names that Windows lacks, and the files that use them beside a twin or behind a question.
POSIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
POSIX_NAMES = {
    "os": {
        *(
            "chown",
            "fchmod",
            "fork",
            "getegid",
            "geteuid",
            "getgid",
            "getloadavg",
            "getpgid",
            "getuid",
            "killpg",
            "kill",
        ),
        *(
            "lchown",
            "mkfifo",
            "mknod",
            "nice",
            "O_CLOEXEC",
            "O_DIRECTORY",
            "O_NOFOLLOW",
            "O_NONBLOCK",
            "openpty",
            "pread",
        ),
        *("sched_getaffinity", "setpgid", "setsid", "statvfs", "sync", "sysconf", "uname", "wait", "wait4", "waitpid"),
    },
    "signal": {
        *("alarm", "pause", "pthread_kill", "pthread_sigmask", "setitimer", "siginterrupt", "sigwait"),
        *("SIGALRM", "SIGCHLD", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTSTP", "SIGUSR1", "SIGWINCH"),
    },
    "socket": {"AF_UNIX", "SO_REUSEPORT"},
    "time": {"tzset", "clock_gettime"},
}
WITH_TWIN = {
    "clsplat/files/lock.py": {"fcntl"},  # else msvcrt
    "clsplat/files/host_memory.py": {"resource"},  # else windows.peak_bytes
    "clsplat/files/atomic.py": {"os.kill"},  # else windows.is_running
    "clsplat/cluster/workers.py": {"os.sched_getaffinity", "signal.pthread_sigmask"},  # else all cores; _IGNORE_CTRL_C
    "clsplat/files/stop_signals.py": {"signal.pthread_kill"},  # else _thread.interrupt_main
}
# Functions of other libraries that have the name of one that opens text files.
OTHER_FUNCTIONS = re.compile(r"importlib\.metadata|Reconstruction\(|Image\.open|\barchive\.open")


def posix_only(tree: ast.AST) -> Iterator[str]:
    """Yield the modules that a module imports and the attributes that it uses, as far as Windows lacks them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from POSIX_MODULES.intersection(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from POSIX_MODULES.intersection([node.module])
            yield from (
                f"{node.module}.{a.name}" for a in node.names if a.name in POSIX_NAMES.get(node.module or "", ())
            )
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield from (f"{node.value.id}.{name}" for name in POSIX_NAMES.get(node.value.id, ()) if name == node.attr)


def nameless_encodings(tree: ast.AST) -> Iterator[str]:
    """Yield the calls that open text, or read it from a process, in the encoding of the machine."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and "encoding" not in {word.arg for word in node.keywords}:
            text = ast.unparse(node)
            if _is_text(node) and not OTHER_FUNCTIONS.search(text):
                yield text


def _is_text(call: ast.Call) -> bool:
    function, method = call.func, isinstance(call.func, ast.Attribute)
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    places = [*call.args, *(word.value for word in call.keywords if word.arg == "mode")]
    modes = [a.value for a in places if isinstance(a, ast.Constant) and re.fullmatch(r"[rwaxbt+]{1,3}", str(a.value))]
    if name == "read_text":  # the encoding is the first argument
        return not call.args
    if name == "write_text":
        return len(call.args) < 2
    if name in ("open", "fdopen"):
        of_path = method and name == "open"
        return (not places or bool(modes) if of_path else True) and not any("b" in mode for mode in modes)
    return name in ("run", "Popen", "check_output") and any(word.arg == "text" for word in call.keywords)


@pytest.mark.parametrize("folder", PRODUCT)
def test_what_only_posix_has_stands_beside_its_twin(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        found = set(posix_only(ast.parse(path.read_text(encoding="utf-8"))))
        assert found == WITH_TWIN.get(name, set()), name


def test_names_of_posix_are_found() -> None:
    text = "import fcntl, os\nfrom os import fork\nos.setsid()\nx.SIGKILL\nsignal.SIGKILL\nfrom .tty import a\n"
    assert sorted(posix_only(ast.parse(text))) == ["fcntl", "os.fork", "os.setsid", "signal.SIGKILL"]


def test_text_has_an_encoding() -> None:
    """Windows would read and write it in the code page of the machine."""
    found = {path: list(nameless_encodings(ast.parse(path.read_text(encoding="utf-8")))) for path in SOURCES}
    assert {path.relative_to(ROOT).as_posix(): calls for path, calls in found.items() if calls} == {}


@pytest.mark.parametrize(
    ("call", "is_found"),
    [
        ("open(path)", True),
        ("open(path, 'w')", True),
        ("open(path, 'rb')", False),
        ("open(path, encoding='ascii')", False),
        ("path.open()", True),
        ("path.open('a')", True),
        ("path.open(mode='w')", True),
        ("path.open('r+b')", False),
        ("os.fdopen(1, 'w')", True),
        ("Image.open(path)", False),
        ("path.read_text()", True),
        ("path.read_text('utf-8')", False),
        ("path.write_text('a')", True),
        ("path.write_text('a', 'utf-8')", False),
        ("subprocess.run(command, text=True)", True),
        ("subprocess.run(command)", False),
    ],
)
def test_calls_without_an_encoding_are_found(call: str, is_found: bool) -> None:
    assert bool(list(nameless_encodings(ast.parse(call)))) == is_found


@pytest.mark.parametrize("folder", PRODUCT)
def test_no_output_needs_a_terminal_with_escape_sequences(folder: str) -> None:
    """Windows' console shows them as letters, unless a program turns them on."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        assert not re.search(r"\\x1b|\\033|\\u001b|click\.style|click\.secho|\bsecho\(", path.read_text("utf-8")), path


def test_every_system_can_check_the_files_out() -> None:
    """No two names differ by case alone, and none has a character that Windows reserves."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, encoding="utf-8")
    if listed.returncode:
        pytest.skip("not a clone of the repository")
    names = listed.stdout.splitlines()
    assert [name for name, count in Counter(map(str.casefold, names)).items() if count > 1] == []
    assert [name for name in names if re.search(r'[<>:"|?*\\]|[. ](/|$)', name)] == []
