"""Call the command line in this process and check its errors."""

from __future__ import annotations

from pathlib import Path

from tofuse.apps.cli.program import main


def call(*words: object) -> int:
    try:
        return main([str(w) for w in words])
    except SystemExit as stop:
        return int(stop.code or 0)


def listing(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def printed(capsys, *words: object) -> str:
    """Call the command, which succeeds, and return what it prints."""
    capsys.readouterr()
    assert call(*words) == 0
    return capsys.readouterr().out


def refuses(capfd, *words: object, says: str | tuple[str, ...], prefix: str = "tofuse: ") -> str:
    """Call the command and check that it prints one line that contains all of `says`."""
    capfd.readouterr()
    assert call(*words) == 2
    done = capfd.readouterr()
    assert done.out == ""
    assert done.err.endswith("\n")
    assert done.err.count("\n") == 1, done.err
    assert done.err.startswith(prefix)
    for part in [says] if isinstance(says, str) else says:
        assert part in done.err
    assert len(done.err) < 700
    return done.err
