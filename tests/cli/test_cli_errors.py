"""Bad input at the command line: one clear line, exit status 2, nothing written."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cli_calls import listing, refuses
from tofuse.apps.cli.program import main
from tofuse.formats.images.images import read_image, write_png
from written import change_camera


@pytest.fixture
def recording(room_recording, tmp_path) -> Path:
    """A copy of the recording with four frames, to be broken."""
    copy = tmp_path / "rec"
    shutil.copytree(room_recording, copy, ignore=shutil.ignore_patterns("truth", "00000[4-7].png"))
    for name in ("groundtruth.txt", "timestamps.txt", "frames.csv"):
        (copy / name).unlink()
    return copy


def truncate_all(recording: Path) -> None:
    for file in (recording / "depth").iterdir():
        file.write_bytes(file.read_bytes()[:60])


def blank_all(recording: Path) -> None:
    for file in (recording / "depth").iterdir():
        write_png(file, np.zeros_like(read_image(file)))


def empty(recording: Path) -> None:
    shutil.rmtree(recording)
    recording.mkdir()


def folder_for_file(recording: Path) -> None:
    (recording / "camera.json").unlink()
    (recording / "camera.json").mkdir()


def folders_for_images(recording: Path) -> None:
    for file in (recording / "depth").iterdir():
        file.unlink()
        file.mkdir()


BROKEN: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "missing folder": (shutil.rmtree, ("rec", "doesn't exist")),
    "empty folder": (empty, ("rec", "empty folder")),
    "all images truncated": (truncate_all, ("none of 4 frames", "000000.png", "cut off")),
    "broken json": (lambda r: (r / "camera.json").write_text('{"a": '), ("camera.json", "JSON")),
    "json bytes": (lambda r: (r / "camera.json").write_bytes(b"\xff\xfe\0"), ("camera.json",)),
    "all frames invalid": (blank_all, ("has 4 frames, none with", "0 valid points")),
    "nan": (lambda r: change_camera(r, fx=float("nan")), ("camera.json", "fx", "nan")),
    "fewer amplitudes": (lambda r: (r / "amplitude/000002.png").unlink(), ("amplitude", "3", "4")),
    "folder for camera.json": (folder_for_file, ("rec",)),
    "folders for images": (folders_for_images, ("rec",)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_bad_recordings_are_rejected(name, recording, tmp_path, capfd) -> None:
    damage, says = BROKEN[name]
    damage(recording)
    before = listing(tmp_path)
    message = refuses(capfd, "run", recording, "--out", tmp_path / "a" / "out", says=says)
    assert ";" in message  # the remedy
    assert listing(tmp_path) == before


def test_unreadable_files_are_rejected(recording, tmp_path, capfd, monkeypatch) -> None:
    # Permissions do not restrict root, so the system call is made to fail.
    def refusing(original: Callable[..., object]) -> Callable[..., object]:
        def read(self: Path, *args: object, **named: object) -> object:
            if self.is_relative_to(recording):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))
            return original(self, *args, **named)

        return read

    for name in ("open", "read_bytes"):
        monkeypatch.setattr(Path, name, refusing(getattr(Path, name)))
    refuses(capfd, "run", recording, "--out", tmp_path / "out", says=("rec", "ermission denied"))
    assert not (tmp_path / "out").exists()


OUTPUTS: dict[str, Callable[[Path], Path]] = {
    "not ours": lambda t: _with(t / "other", "photo.jpg"),
    "a file": lambda t: _with(t / "other", "file") / "file",
    "below a file": lambda t: _with(t / "other", "file") / "file" / "out",
    "the recording": lambda t: t / "rec",
}


def _with(folder: Path, name: str) -> Path:
    folder.mkdir()
    (folder / name).write_text("mine")
    return folder


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_bad_output_folders_are_rejected(name, options, recording, tmp_path, capfd) -> None:
    out = OUTPUTS[name](tmp_path)
    before = listing(tmp_path)
    refuses(capfd, "run", recording, "--out", out, *options, says=(str(tmp_path),))
    assert listing(tmp_path) == before


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_unwritable_output_is_reported(code, recording, tmp_path, capfd, monkeypatch):
    open_file = Path.open

    def full(self: Path, mode: str = "r", *args: object, **named: object) -> object:
        if "w" not in mode:
            return open_file(self, mode, *args, **named)
        raise OSError(code, os.strerror(code), str(self))

    monkeypatch.setattr(Path, "open", full)
    before = listing(tmp_path)
    out = tmp_path / "out"
    words = ("run", recording, "--out", out)
    message = refuses(capfd, *words, says=(str(tmp_path), "can't be written"))
    assert os.strerror(code).lower() in message.lower()
    assert ".tofuse" not in message
    assert listing(tmp_path) == before


RUN = "run REC --out OUT "
# Words of the command, parts of the message between bars, and the beginning of the message.
USAGE = [
    ("fuse", "'fuse'", "tofuse: "),
    ("rnu", "'rnu' (did you mean run?)", "tofuse: "),
    ("run --out OUT", "INPUT", "tofuse run: "),
    ("run REC", "--out", "tofuse run: "),
    (RUN + "--fast", "--fast", "tofuse"),
    (RUN + "--threads 0", "--threads|0", "tofuse run: "),
    (RUN + "--seed -1", "--seed|-1", "tofuse run: "),
    (RUN + "--every 0", "--every|0", "tofuse run: "),
    (RUN + "--memory 1", "--memory|is less than 500 MB|2GB", "tofuse: "),
    (RUN + "--guess luck", "--guess|'luck'", "tofuse run: "),
    (RUN + "--min-depth 3 --max-depth 2", "--max-depth|3.0|2.0", "tofuse: "),
    ("run REC --output DIR", "unknown option --output (did you mean --out?)", "tofuse run: "),
    ("REC", "a path: `tofuse inspect|tofuse run|--out result", "tofuse: "),
    ("run REC -o DIR", "unknown option -o", "tofuse run: "),
    ("run REC --start -5", "required: --out", "tofuse run: "),
    (RUN + "--maxdepth 3", "--maxdepth|did you mean --max-depth?", "tofuse run: "),
    ("demo room", "room", "tofuse demo: "),
    (RUN + "--view --no-report", "--no-report: can't be used with --view", "tofuse: "),
    ("run REC REC --out OUT", "REC: is given twice", "tofuse: "),
    ("register REC REC --risk low", "--risk: 'low' is not a number", "tofuse register: "),
    (RUN + "--method magic", "--method|'magic'; use one of default, thesis", "tofuse: "),
    (RUN + "--moving ignore --method thesis", "--moving: does not apply|'sequential'", "tofuse: "),
    (RUN + "--format magic", "--format|'magic'|native", "tofuse: "),
    (RUN + "--format tum", "REC", "tofuse: "),
    (RUN + "--start 9", "REC|selection leaves none|--start", "tofuse: "),
    (RUN + "--start 2 --end 1", "REC|--end", "tofuse: "),
    (RUN + "--guess odometry", "--guess|odometry.txt", "tofuse: "),
    (RUN + "--config none.toml", "none.toml", "tofuse: "),
    (RUN + "--camera none.json", "none.json", "tofuse: "),
    (RUN + "--loops none.txt", "none.txt", "tofuse: "),
    ("run REC none --out OUT", "none", "tofuse: "),
    ("simulate moon --out OUT", "moon|room", "tofuse: "),
    ("simulate room --out OUT --camera eye", "eye|sr4000", "tofuse: "),
    ("simulate room --out OUT --without magic", "magic|shot_noise", "tofuse: "),
    ("simulate room --out OUT --frames 0", "--frames|0", "tofuse simulate: "),
    ("simulate box --out REC", "REC", "tofuse: "),
    ("record eye --out OUT", "'eye'; use one of azure-kinect, ifm-o3r", "tofuse: "),
    ("demo --scene moon", "moon|room", "tofuse demo: "),
    ("demo --out REC --overwrite", "REC", "tofuse: "),
    ("merge REC REC", "--out", "tofuse merge: "),
    ("merge REC --out OUT", "REC|run.json", "tofuse: "),
    ("inspect none", "none", "tofuse: "),
    ("evaluate REC REC", "trajectory.txt", "tofuse: "),
    ("optimize none.g2o --out OUT", "none.g2o", "tofuse: "),
    ("optimize none.g2o --out REC/camera.json", "REC/camera.json|--overwrite", "tofuse: "),
    ("optimize none.g2o --out REC", "--out|is a folder", "tofuse: "),
]  # fmt: skip


@pytest.mark.parametrize(("words", "says", "prefix"), USAGE)
def test_bad_usage_is_reported(
    words, says, prefix, recording, tmp_path, capfd, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.move(recording, tmp_path / "REC")
    before = listing(tmp_path)
    refuses(capfd, *words.split(), says=tuple(says.split("|")), prefix=prefix)
    assert listing(tmp_path) == before


@pytest.mark.parametrize("words", [[], ["rig"]])
def test_missing_command_prints_help(words, capsys) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(words)
    out, err = capsys.readouterr()
    assert stopped.value.code == 0
    assert out.startswith("usage: tofuse")
    assert "commands:" in out
    assert not err


CONFIGS: dict[str, tuple[str, tuple[str, ...]]] = {
    "bad toml": ("filters = [", ("is not TOML",)),
    "not text": ("\xff\xff", ("is not text",)),
    "unknown nested option": (
        "[odometry.registration]\nresolutoin = 1",
        ("odometry.registration", "'resolutoin'", " resolution,"),
    ),
    "unknown part": ("[[filters]]\npart = 'magic'", ("filters[0]", "'magic'", " median,")),
    "no part": ("[[filters]]\nsize = 3", ("filters[0]: names no part; set part to one of ",)),
    "length with a unit": ("[fusion]\nvoxel_m = '1cm'", ("voxel_m: is '1cm'; use a number",)),
    "word for a switch": ("self_calibration = 'no'", ("is 'no'; use true or false",)),
    "number for a part": ("odometry = 3", ("odometry", "is 3", " sequential")),
    "unknown method": ("method = 'magic'", ("my.toml: method", "'magic'", "default, thesis")),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_bad_configurations_are_rejected(name, recording, tmp_path, capfd) -> None:
    text, says = CONFIGS[name]
    config = tmp_path / "my.toml"
    config.write_text(text, encoding="latin-1")
    words = ("run", recording, "--out", tmp_path / "out", "--config", config)
    if "method" not in text:
        words += ("--method", "thesis")
    message = refuses(capfd, *words, says=says)
    assert "my.toml" in message or "--method" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"schema": 1}', '{"schema": 1, "config": 3}', "{}"])
def test_invalid_run_json_is_rejected(text, recording, tmp_path, capfd) -> None:
    config = tmp_path / "run.json"
    config.write_text(text)
    words = ("run", recording, "--out", tmp_path / "out", "--config", config)
    refuses(capfd, *words, says=("run.json",))
