"""Recordings in .zip files, as phones share them."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import made_phones as made
from refused import refused
from tofuse.apps.cli.program import main
from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.engine.errors import InputError, InputWarning, UnreadableFrameError
from tofuse.formats.recordings.archives import unzipped
from tofuse.formats.recordings.open import open_recording, open_view


def zipped(folder: Path, path: Path, inside: str = "") -> Path:
    """An archive of a folder, with what macOS adds."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            archive.write(file, Path(inside) / file.relative_to(folder))
        archive.writestr("__MACOSX/._frame_00000.json", b"\0\5\26\7")
        archive.writestr(f"{inside}/.DS_Store".lstrip("/"), b"Bud1")
    return path


@pytest.mark.parametrize(
    "make", [made.make_scanner_app, made.make_stray, made.make_record3d], ids=lambda m: m.__name__
)
@pytest.mark.parametrize("inside", ["", "2026-11-02 scan", "export/scan 1"])
def test_export_of_app_opens_as_it_is(make, inside: str, tmp_path: Path) -> None:
    make(tmp_path / "scan")
    expected = open_recording(tmp_path / "scan")
    path = zipped(tmp_path / "scan", tmp_path / "scan.ZIP", inside)
    shutil.rmtree(tmp_path / "scan")
    found = open_recording(path)
    assert (found.format, found.path) == (expected.format, str(path))
    np.testing.assert_array_equal(found.timestamps, expected.timestamps)
    for k in range(len(found)):
        assert np.isfinite(found[k].depth).all()
    assert len(open_view(f"{path}#1").frame)
    assert unzipped(path) == unzipped(path)


def test_archive_of_windows_program(tmp_path: Path) -> None:
    """Some separate folders by backslashes."""
    made.make_scanner_app(tmp_path / "scan")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for file in (tmp_path / "scan").iterdir():
            archive.writestr(f"Scan 1\\{file.name}", file.read_bytes())
    assert len(open_recording(tmp_path / "a.zip")) == 3


def test_archive_that_is_not_unpacked_is_named_so(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    (tmp_path / "folder").mkdir()
    zipped(tmp_path / "scan", tmp_path / "folder" / "scan.zip")
    (tmp_path / "scan.tar.gz").write_bytes(b"\x1f\x8b")
    for name in ("folder", "scan.tar.gz"):
        refused(r"is an archive, .* unpack any other", tmp_path / name)


def test_archive_in_an_archive(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    inner = zipped(tmp_path / "scan", tmp_path / "scan.zip", "scan")
    for name in ("once.zip", "twice.zip"):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.write(inner, inner.name)
        inner = tmp_path / name
    assert len(open_recording(tmp_path / "once.zip")) == 3
    # One that contains itself would never end.
    refused(r"^\S*twice.zip/\S*: is an archive", tmp_path / "twice.zip")


def test_archive_beside_a_folder_is_not_all_there_is(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "scan.zip").touch()
    refused(r"it contains 1 \S+, 1 \S+", tmp_path)


def test_archive_of_single_file_is_that_file(tmp_path: Path) -> None:
    pytest.importorskip("lzfse")
    made.make_r3d(tmp_path / "scan.r3d")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "scan.r3d", "scan.r3d")
    assert open_recording(tmp_path / "a.zip").format == "record3d"


def test_messages_name_the_archive(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    made.make_scanner_app(folder)
    (folder / "depth_00001.png").write_bytes(b"")
    with pytest.raises(UnreadableFrameError) as error:
        open_recording(zipped(folder, tmp_path / "frame.zip", "scan 1"))[1]
    assert error.value.where == str(tmp_path / "frame.zip" / "scan 1" / "depth_00001.png")
    for file in folder.glob("frame_*.json"):
        file.write_text("{}")
    with pytest.raises(InputError, match="time") as refused:
        open_recording(zipped(folder, tmp_path / "lens.zip"))
    assert str(refused.value).startswith(f"{tmp_path / 'lens.zip' / 'frame_00000.json'}: time")
    made.make_stray(tmp_path / "stray")
    (tmp_path / "stray" / "imu.csv").write_text("timestamp\n1\n")
    warnings = open_recording(zipped(tmp_path / "stray", tmp_path / "imu.zip")).warnings
    assert any(line.startswith(f"{tmp_path / 'imu.zip' / 'imu.csv'}: ") for line in warnings)


def test_facts_name_the_archive(room_recording: Path, tmp_path: Path) -> None:
    path = zipped(room_recording, tmp_path / "room.zip")
    assert inspect_recording(path, quick=True).facts["truth"] == str(path / "truth")


def test_unpacked_files_are_removed_with_the_process(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    path = zipped(tmp_path / "scan", tmp_path / "scan.zip")
    code = (
        "import sys; from tofuse.formats.recordings import open_recording, unzipped;"
        "open_recording(sys.argv[1]); print(unzipped(sys.argv[1]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, check=True
    )
    folder = Path(done.stdout.strip())
    assert folder.name == path.name
    assert not folder.parent.exists()


def encrypted(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("info.json", "{}")
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        struct.pack_into("<H", data, data.index(signature) + offset, 1)
    path.write_bytes(data)


def with_member(name: str, link: bool = False):
    def make(path: Path) -> None:
        member = zipfile.ZipInfo(name)
        member.external_attr = (0o120777 if link else 0o100644) << 16
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(member, "/etc/passwd")

    return make


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.raw", bytes(200_000_000))


def cut_off(path: Path) -> None:
    made.make_scanner_app(path.with_suffix(""))
    zipped(path.with_suffix(""), path)
    path.write_bytes(path.read_bytes()[:-40])


def cut_off_after_archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("camera.json", b"{}")
        with archive.open("correction.npz", "w") as file:
            np.savez(file, curve=np.zeros(3))
        end = archive.fp.tell()
    path.write_bytes(path.read_bytes()[:end])


def damage(path: Path, member: str) -> None:
    """Change some bytes of a file in an archive."""
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo(member).header_offset + 30 + len(member)
    data = bytearray(path.read_bytes())
    data[start + 10 : start + 15] = b"\xff" * 5
    path.write_bytes(data)


def damaged(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("info.json", b"abcdefgh" * 1000)
    damage(path, "info.json")


def test_damaged_image_in_archive_costs_its_frame_alone(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    path = zipped(tmp_path / "scan", tmp_path / "scan.zip", "scan")
    damage(path, "scan/depth_00001.png")
    with pytest.warns(InputWarning, match=r"scan\.zip: scan/depth_00001\.png can't be unpacked"):
        recording = open_recording(path)
    assert [frame.index for frame in recording.readable(3)] == [0, 2]
    with pytest.raises(UnreadableFrameError, match=r"depth_00001\.png"):
        recording[1]


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (encrypted, "is encrypted"),
        (with_member("../outside.txt"), "outside of itself"),
        (with_member("/outside.txt"), "outside of itself"),
        (with_member("..\\outside.txt"), "outside of itself"),
        (with_member("C:\\outside.txt"), "outside of itself"),
        (with_member("link", link=True), "contains a link"),
        (bomb, "far more than measurements"),
        (cut_off, "copy the file again"),
        (cut_off_after_archive, "is cut off before its end"),
        (damaged, "copy the file again"),
        (lambda path: zipfile.ZipFile(path, "w").close(), "is an empty archive"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_unsafe_archive_is_refused_in_one_line(make, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "scan.zip"
    make(path)
    with pytest.raises(InputError, match=problem) as error:
        open_recording(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    assert not (tmp_path.parent / "outside.txt").exists()


def test_report_has_the_name_of_the_scan_without_that_of_the_archive(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    (tmp_path / "scan/conf_00000.png").unlink()
    path = zipped(tmp_path / "scan", tmp_path / "my chair.ZIP")
    main(["run", str(path), "--out", str(tmp_path / "out"), "--threads", "1"])
    assert "<title>my chair" in (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert "no confidence image for 1 frame" in open_recording(path).warnings
