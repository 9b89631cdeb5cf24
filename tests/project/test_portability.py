"""Features that Windows or macOS lack are used only after a check."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from paths import SOURCE

# Features that some systems lack. A use counts as guarded inside of an `if` (or after one that
# returns) that checks with `hasattr`, or for the system by `sys.platform` or `os.name`; or in a
# `try` that catches the resulting error.
MODULES = {"fcntl", "msvcrt", "resource", "pwd", "grp", "termios", "tty", "pty", "winreg", "syslog",
           "posix", "nt", "_winapi", "spwd", "crypt"}  # fmt: skip
ATTRIBUTES = {
    "os": {"sched_getaffinity", "sched_setaffinity", "fork", "forkpty", "getuid", "geteuid",
           "getgid", "setuid", "getpgid", "setsid", "killpg", "mkfifo", "mknod", "sysconf", "uname",
           "O_NOFOLLOW", "O_NONBLOCK", "O_DIRECTORY", "O_BINARY", "O_CLOEXEC", "getloadavg",
           "pread", "pwrite", "sendfile", "statvfs", "nice", "wait", "waitpid", "lchmod", "chown",
           "startfile", "register_at_fork", "memfd_create", "getxattr", "sync", "fchmod",
           "posix_fallocate", "posix_fadvise", "copy_file_range", "process_cpu_count"},
    "signal": {"SIGKILL", "SIGHUP", "SIGALRM", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGSTOP",
               "SIGCONT", "SIGCHLD", "SIGBREAK", "CTRL_C_EVENT", "alarm", "setitimer", "pause",
               "sigwait", "pthread_kill", "pthread_sigmask", "set_wakeup_fd"},
    "select": {"poll", "epoll", "kqueue"},
    "socket": {"AF_UNIX", "SO_REUSEPORT"},
    "time": {"tzset", "clock_gettime", "CLOCK_BOOTTIME"},
    "subprocess": {"STARTUPINFO", "CREATE_NEW_PROCESS_GROUP"},
}  # fmt: skip
KEYWORDS = {"pass_fds", "preexec_fn"}  # of subprocess, not supported on Windows


def needs(node: ast.AST) -> list[str]:
    """Names used by a node that some systems lack."""
    if isinstance(node, ast.Import):
        return [a.name for a in node.names if a.name.split(".")[0] in MODULES]
    if isinstance(node, ast.ImportFrom):
        module, names = node.module or "", [a.name for a in node.names]
        if module.split(".")[0] in MODULES:
            return [module]
        return [f"{module}.{n}" for n in names if n in ATTRIBUTES.get(module, ())]
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        module = node.value.id
        return [f"{module}.{node.attr}"] if node.attr in ATTRIBUTES.get(module, ()) else []
    if isinstance(node, ast.Call):
        return [k.arg for k in node.keywords if k.arg in KEYWORDS and not _empty(k.value)]
    return []


def _empty(value: ast.expr) -> bool:
    """Whether a value is chosen by the system."""
    return isinstance(value, ast.IfExp) and _asks(value.test)


def _asks(test: ast.expr) -> bool:
    """Whether a condition checks for a system, or for a feature."""
    text = ast.unparse(test)
    return "sys.platform" in text or "os.name" in text or "hasattr(" in text


def _catches(handler: ast.ExceptHandler) -> bool:
    text = "" if handler.type is None else ast.unparse(handler.type)
    return any(name in text for name in ("ImportError", "AttributeError"))


def unguarded(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of each use that is not guarded."""

    def walk(node: ast.AST, guarded: bool) -> Iterator[tuple[int, str]]:
        if not guarded:
            yield from ((node.lineno, name) for name in needs(node))
        if isinstance(node, ast.If | ast.IfExp) and _asks(node.test):
            yield from walk(node.test, True)
            for part in ("body", "orelse"):
                found = getattr(node, part)
                for child in found if isinstance(found, list) else [found]:
                    yield from walk(child, True)
            return
        if isinstance(node, ast.Try) and any(_catches(h) for h in node.handlers):
            for child in node.body:
                yield from walk(child, True)
            for child in (*node.handlers, *node.orelse, *node.finalbody):
                yield from walk(child, guarded)
            return
        for _name, value in ast.iter_fields(node):
            children = value if isinstance(value, list) else [value]
            inside = guarded
            for child in children:
                if isinstance(child, ast.AST):
                    yield from walk(child, inside)
                    # `if sys.platform == "win32": return` guards what comes after it.
                    ends = isinstance(child, ast.If) and isinstance(
                        child.body[-1], ast.Return | ast.Raise | ast.Continue
                    )
                    inside = inside or (ends and _asks(child.test))

    yield from walk(tree, False)


def test_uses_of_missing_features_are_guarded() -> None:
    found = [
        f"{path.relative_to(SOURCE)}:{line}: {name}"
        for path in sorted(SOURCE.rglob("*.py"))
        for line, name in unguarded(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("import fcntl", ["fcntl"]),
        ("from resource import getrlimit", ["resource"]),
        ("import os\nos.sched_getaffinity(0)", ["os.sched_getaffinity"]),
        ("from os import fork", ["os.fork"]),
        ("import signal\nsignal.signal(signal.SIGHUP, f)", ["signal.SIGHUP"]),
        ("import subprocess\nsubprocess.Popen([], preexec_fn=f)", ["preexec_fn"]),
        ("import sys\nif sys.platform != 'win32':\n    import fcntl", []),
        ("import sys\nif x:\n    import fcntl", ["fcntl"]),
        ("import os\nif hasattr(os, 'fork'):\n    os.fork()", []),
        ("import os\nn = os.getuid() if hasattr(os, 'getuid') else 0", []),
        ("import os\ndef f():\n    if os.name == 'nt':\n        return 1\n    import fcntl", []),
        ("import sys\ndef f():\n    if sys.platform == 'win32':\n        x()\n    import fcntl",
         ["fcntl"]),
        ("try:\n    import resource\nexcept ImportError:\n    resource = None", []),
        ("try:\n    import resource\nexcept OSError:\n    pass", ["resource"]),
        ("import signal\nsignal.signal(signal.SIGINT, f)", []),
    ],
)  # fmt: skip
def test_detection_of_unguarded_uses(text: str, names: list[str]) -> None:
    assert [name for _, name in unguarded(ast.parse(text))] == names
