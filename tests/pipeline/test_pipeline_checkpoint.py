"""Interrupted runs resume, with the results of an uninterrupted run."""

from __future__ import annotations

import io
import json
import os
import pickle
import signal
import subprocess
import sys
import zipfile
from collections import OrderedDict, deque
from pathlib import Path

import numpy as np
import pytest

import tofuse
from corner_views import corner
from kept_stages import Kept, Stopped
from tofuse.cli import main
from tofuse.errors import InputError, OutputError
from tofuse.files import spill as spill_module
from tofuse.files.npz import read_npz, write_npz
from tofuse.files.spill import Spill
from tofuse.lab.simulation.record import simulate
from tofuse.pipeline import checkpoint, reconstruct, run
from tofuse.pipeline.checkpoint import Checkpoints, digest
from tofuse.pipeline.config import changed, from_method
from tofuse.pipeline.states import StateError, decode, encode, serialisable_types
from tofuse.posegraph.view_store import SampledView
from tofuse.registration.prepared_view import prepare_view
from tofuse.registration.surface_options import SurfaceOptions
from tofuse.results.folder import CHECKPOINT, STAGING
from tofuse.results.samples import FrameSample
from tofuse.results.types import FrameRecord
from written_run_json import run_json

SAME = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply", "mesh.glb")


def comparable(result: tofuse.Reconstruction) -> list[object]:
    """Everything that must be identical."""
    data = run_json(result)
    del data["seconds"]
    cloud, mesh, graph = result.cloud, result.mesh, result.graph
    arrays = [result.trajectory, result.diagnostics.sequential, graph.poses, graph.information]
    arrays += [cloud.points, cloud.normals, cloud.color, cloud.views, cloud.sigma]
    arrays += [] if mesh is None else [mesh.vertices, mesh.faces, mesh.normals, mesh.views]
    return [json.dumps(data), *(None if a is None else a.tobytes() for a in arrays)]


@pytest.fixture(scope="module")
def turned_box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clouds without a camera, around the peaks."""
    return simulate("peaks", tmp_path_factory.mktemp("clouds") / "peaks", frames=3)


@pytest.mark.slow
def test_stopped_run_resumes_at_any_stage(room_recording: Path, monkeypatch) -> None:
    recording = tofuse.open(room_recording).select(every=2)
    kept_as_it_is = [{"part": "noise"}, {"part": "multipath", "trial": False}]
    known = {"views": {"falloff": 0.0, "range_falloff": 0.0}}  # not looked for then
    coarse = {"voxel_m": 0.05}
    changes = {"corrections": kept_as_it_is, "odometry": known, "fusion": coarse}
    config = changed(from_method("default"), changes, where="test")
    never = Kept(0)
    whole = reconstruct.reconstruct(recording, config, seed=3, stages=never)
    assert never.saved == ["tracking"] * 4 + ["joining", "loops", "refinement", "fusion"]
    assert comparable(reconstruct.reconstruct(recording, config, seed=3)) == comparable(whole)
    read = recording.source.read
    for stop_at in (2, 6):
        kept = Kept(stop_at)
        with pytest.raises(Stopped):
            reconstruct.reconstruct(recording, config, seed=3, stages=kept)
        kept.stop_at, before = 0, len(kept.saved)
        seen: list[int] = []
        monkeypatch.setattr(
            recording.source, "read", lambda i, seen=seen: seen.append(i) or read(i)
        )
        again = reconstruct.reconstruct(recording, config, seed=3, stages=kept, threads=1)
        monkeypatch.undo()
        assert kept.saved[before:] == never.saved[before:]
        rest = list(range(2 * stop_at, 8, 2))  # nothing is tracked twice
        assert seen[3:] == rest  # after a look ahead at three
        again = tofuse.Reconstruction(**{**vars(again), "threads": whole.threads})
        assert comparable(again) == comparable(whole)
        assert set(again.diagnostics.seconds) == set(whole.diagnostics.seconds)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["default", "thesis"])
def test_runs_of_clouds_resume(method: str, turned_box: Path) -> None:
    recording = tofuse.open(turned_box)
    config = changed(from_method(method, "cloud"), {"filters": []}, where="test")
    whole = reconstruct.reconstruct(recording, config)
    kept = Kept(2)
    with pytest.raises(Stopped):
        reconstruct.reconstruct(recording, config, stages=kept)
    kept.stop_at = 0
    assert comparable(reconstruct.reconstruct(recording, config, stages=kept)) == comparable(whole)


def test_states_are_kept_for_one_key(tmp_path: Path) -> None:
    notes: list[str] = []
    one = Checkpoints(tmp_path, "a", notes.append)
    assert (one.fresh, one.load("loops")) == (None, None)
    one.begin(fresh=True)
    state = {"a": np.arange(5.0), "b": [1, "x", None]}
    one.save("loops", state)
    assert os.listdir(tmp_path) == [CHECKPOINT]

    again = Checkpoints(tmp_path, "a", notes.append)
    assert again.fresh
    found = again.load("loops")
    assert found["b"] == state["b"]
    np.testing.assert_array_equal(found["a"], state["a"])
    assert notes == []

    other = Checkpoints(tmp_path, "b", notes.append)
    assert other.fresh is None
    assert other.load("fusion") is None
    assert Checkpoints(tmp_path, "a", notes.append).fresh  # until another run really begins
    other.begin(fresh=False)
    assert len(notes) == 1
    assert "is not used" in notes[0]
    assert os.listdir(tmp_path / CHECKPOINT) == []
    other.save("loops", state)
    assert Checkpoints(tmp_path, "b", notes.append).fresh is False
    other.discard()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("damage", ["short", "flipped", "empty", "other"])
def test_damaged_state_is_not_used(damage: str, tmp_path: Path) -> None:
    notes: list[str] = []
    kept = Checkpoints(tmp_path, "a", notes.append)
    kept.save("fusion", [np.arange(1000)])
    (path,) = (tmp_path / CHECKPOINT).iterdir()
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 1
    made = {"short": data[:-100], "flipped": data, "empty": b"", "other": b"tofuse check\n{}"}
    path.write_bytes(made[damage])
    assert kept.load("fusion") is None
    assert "damaged, and not used" in notes[0]
    assert not path.exists()


class Harmful:
    def __reduce__(self):
        return os.system, ("touch harmed",)


@pytest.mark.parametrize(
    "state",
    [Harmful(), Path("x"), np.array([Harmful()], object), main, Checkpoints, np.dtype("f4"), 1j],
)
def test_foreign_types_are_not_stored(state: object, tmp_path: Path) -> None:
    notes: list[str] = []
    kept = Checkpoints(tmp_path / "out", "a", notes.append)
    kept.save("fusion", state)
    assert "can't be stored" in notes[0]
    assert kept.load("fusion") is None


def test_loadable_types_have_no_side_effects() -> None:
    assert {name.partition(".")[0] for name in serialisable_types()} == {"tofuse"}
    for cls in serialisable_types().values():
        assert not issubclass(cls, BaseException | os.PathLike | tuple | type)
        assert not hasattr(cls, "__del__")
        assert not hasattr(cls, "__reduce_ex__") or cls.__reduce_ex__ is object.__reduce_ex__


def test_state_round_trip() -> None:
    nan, shared = float("nan"), [np.arange(6.0).reshape(2, 3), b"\x00\xff"]
    looped: dict[object, object] = {(1, "a"): shared, 2.5: shared, None: (shared, {3, 4})}
    looped["self"] = looped
    state = {
        "loop": looped,
        "numbers": [nan, -0.0, np.inf, 10**30, True, np.float32(0.1), np.uint16(7)],
        "queue": deque([1, [2]], maxlen=3),
        "order": OrderedDict([("b", 1), ("a", frozenset({1}))]),
        "turned": np.asfortranarray(np.arange(60_000, dtype=np.int16).reshape(300, 200)),
        "nothing": (np.zeros((0, 3), np.float32), np.array(5), [], "\ud800"),
        "frame": FrameRecord(3, 0.1, "tracked", covariance=np.eye(6)),
    }
    found = decode(dict(encode(state)))
    assert list(found) == list(state)
    loop = found["loop"]
    assert loop["self"] is loop
    assert loop[1, "a"] is loop[2.5]
    assert loop[None][0] is loop[2.5]
    assert loop[None][1] == {3, 4}
    np.testing.assert_array_equal(loop[2.5][0], shared[0])
    assert loop[2.5][1] == shared[1]
    assert str(found["numbers"]) == str(state["numbers"])
    assert [type(n) for n in found["numbers"]] == [type(n) for n in state["numbers"]]
    assert (found["queue"], found["queue"].maxlen) == (state["queue"], 3)
    assert found["order"] == state["order"]
    assert found["turned"].flags.f_contiguous
    np.testing.assert_array_equal(found["turned"], state["turned"])
    assert [a.shape for a in found["nothing"][:2]] == [(0, 3), ()]
    assert found["nothing"][2:] == ([], "\ud800")
    assert isinstance(found["frame"], FrameRecord)
    found["frame"].covariance[0, 0] = 5.0


@pytest.mark.slow
def test_large_state_is_stored_in_parts() -> None:
    many = [np.full(200, float(k)) for k in range(12_000)]
    state = {"arrays": many, "tuples": [(k, many[k % 7]) for k in range(20_000)]}
    arrays = dict(encode(state))
    largest = max(array.nbytes for array in arrays.values())
    assert largest < 0.9 * sum(array.nbytes for array in many)
    found = decode(arrays)
    np.testing.assert_array_equal(found["arrays"], many)
    assert [k for k, _ in found["tuples"]] == list(range(20_000))
    assert all(a is found["arrays"][k % 7] for k, a in found["tuples"])
    assert sum(name.startswith("nodes-") for name in arrays) == 2
    del arrays["nodes-1"]
    with pytest.raises(StateError):
        decode(arrays)


def test_derived_values_are_not_stored() -> None:
    view = SampledView.of(prepare_view(corner(np.eye(4)), SurfaceOptions(radii=(2,))), 100)
    assert len(view.patches) == len(view.points)
    found = decode(dict(encode(view)))
    assert "patches" in vars(view)
    assert "patches" not in vars(found)
    np.testing.assert_array_equal(found.centroid, view.centroid)


FORGED: dict[str, object] = {
    "nothing": [],
    "no list": {"a": 1},
    "no node": [1],
    "leads nowhere": [["tuple", [7]]],
    "before all": [["tuple", [-1]]],
    "a tuple in itself": [["tuple", [0]]],
    "many deep": [*([["list", [k + 1]] for k in range(50_000)]), ["list"]],
    "code": [["list", [1]], ["object", "os.system"]],
    "a class of NumPy": [["list", [1]], ["object", "numpy.ndarray"]],
    "a class of ours that opens files": [["list", [1]], ["object", "tofuse.files.locking.Claim"]],
    "an attribute for a field": [
        ["list", [1]],
        ["object", f"{FrameRecord.__module__}.FrameRecord"],
    ],
    "attributes more": [
        ["tuple", [1]],
        ["object", "tofuse.posegraph.view_store.Spacing", "__class__", 1],
    ],
    "an odd table": [["list", [1]], ["dict", 1]],
    "a list as a key": [["list", [1]], ["dict", [2], 1], ["list"]],
    "an array that is not there": [["list", [1]], ["array", "x", 0, 1, False, 1]],
    "an array that is longer": [["list", [1]], ["array", "a", 0, 99, False, 99]],
    "an array before its start": [["list", [1]], ["array", "a", -4, 8, False, 8]],
    "an array that is taken often": [
        ["list", *([k] for k in range(1, 9))],
        *[["array", "a", 0, 7, False, 7]] * 8,
    ],
    "another shape": [["list", [1]], ["array", "a", 0, 8, False, 3, 3]],
    "no shape": [["list", [1]], ["array", "a", 0, 8, False, "x"]],
    "an endless queue": [["list", [1]], ["deque", -5, 1]],
    "a number that is none": [["list", [1]], ["float", "x"]],
}


@pytest.mark.parametrize("name", FORGED)
def test_forged_state_is_refused(name: str, tmp_path: Path) -> None:
    nodes = np.frombuffer(json.dumps(FORGED[name]).encode(), np.uint8)
    arrays = {"nodes-0": nodes, "a": np.arange(8.0)}
    with pytest.raises(StateError) as caught:
        decode(arrays)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    notes: list[str] = []
    kept = Checkpoints(tmp_path, "a", notes.append)
    kept.save("fusion", [1])
    path = kept.folder / "fusion.state"
    made = read_npz(path)
    with path.open("wb") as file:
        write_npz(file, (made | arrays).items())
    assert kept.load("fusion") is None
    assert "damaged, and not used" in notes[0]
    assert not path.exists()


def pickled() -> bytes:
    return pickle.dumps(Harmful())


def zipped(name: str, data: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        archive.writestr(name, data)
    return made.getvalue()


def array(value: np.ndarray) -> bytes:
    made = io.BytesIO()
    np.save(made, value, allow_pickle=True)
    return made.getvalue()


def claims(shape: tuple[int, ...]) -> bytes:
    made = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(made, header)
    return made.getvalue() + bytes(64)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00" * 100,
        pickled(),
        zipped("header.npy", pickled()),
        zipped("header.npy", array(np.array([Harmful()], object))),
        zipped("header.npy", claims((10**15,))),
        zipped("header.npy", claims((2**62, 2**62))),
        zipped("header.npy", claims((1,)), zipfile.ZIP_DEFLATED),
        zipped("header.npy", array(np.zeros(10**7)), zipfile.ZIP_DEFLATED),
        zipped("header.npy", b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535),
        zipped("../../header.npy", array(np.zeros(3))),
        zipped("header", b"{}"),
    ],
)
def test_invalid_state_file_is_not_used(data: bytes, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    notes: list[str] = []
    path = tmp_path / "out" / CHECKPOINT / "fusion.state"
    path.parent.mkdir(parents=True)
    path.write_bytes(data)
    kept = Checkpoints(tmp_path / "out", "a", notes.append)
    assert kept.fresh is None
    assert kept.load("fusion") is None
    assert "damaged, and not used" in notes[0]
    assert not Path("harmed").exists()


def test_valid_but_wrong_state_ends_in_one_line(turned_box: Path, tmp_path, capfd) -> None:
    """A state forged with the right key passes all checks, at the cost of one more attempt."""
    out = tmp_path / "out"
    words = ["run", str(turned_box), "--out", str(out), "--method", "thesis"]
    seen: list[tuple[Path, str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Checkpoints, "begin", lambda self, fresh: seen.append((self.folder, self._key))
        )
        patch.setattr(run, "reconstruct", lambda *_a, **_o: (_ for _ in ()).throw(Stopped))
        with pytest.raises(Stopped):
            main(words)
    (folder, key) = seen[0]
    for state in ({"mapper": 5}, [1, 2], "x"):
        Checkpoints(out, key, pytest.fail).save("tracking", state)
        capfd.readouterr()
        assert main(words) == 2
        message = capfd.readouterr().err
        assert message.startswith(f"tofuse: {folder}: can't resume from the checkpoint")
        assert message.count("\n") == 1
        assert not folder.exists()
        assert not (out / "run.json").exists()


def test_failed_checkpoint_does_not_stop_run(tmp_path: Path, monkeypatch) -> None:
    notes: list[str] = []
    kept = Checkpoints(tmp_path, "a", notes.append)
    kept.save("tracking", [1])
    kept.save("loops", [lambda: 1])
    assert "can't save" in notes[0]
    assert os.listdir(tmp_path) == []
    kept.save("fusion", [1])
    assert os.listdir(tmp_path) == []
    assert not kept.due()

    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    other = Checkpoints(tmp_path, "a", notes.append)
    monkeypatch.setattr(os, "replace", full)
    other.save("fusion", [1])
    assert "no space left" in notes[1]
    assert os.listdir(tmp_path) == []


def test_checkpoint_is_kept_after_output_error(tmp_path: Path, monkeypatch) -> None:
    for error, seconds, stays in (
        (OutputError("is full"), 0.0, True),
        (OutputError("is full"), 60.0, False),
        (InputError("is bad"), 0.0, False),
        (KeyboardInterrupt(), 0.0, True),
        (KeyboardInterrupt(), 60.0, False),
    ):
        monkeypatch.setattr(checkpoint, "_MIN_KEPT_RUN_S", seconds)
        kept = Checkpoints(tmp_path, "a", lambda _text: None)
        kept.save("tracking", [1])
        kept.give_up(error)
        assert (tmp_path / CHECKPOINT).exists() == stays
        kept.discard()


def test_digest_covers_configuration_and_input(tmp_path: Path) -> None:
    folder, out = tmp_path / "rec", tmp_path / "rec" / "out"
    (folder / "depth").mkdir(parents=True)
    image = folder / "depth" / "0.png"
    image.write_bytes(b"one")
    out.mkdir()
    before = digest({"seed": 0}, [folder], excluded=out)
    (out / "run.json").write_text("{}")
    assert digest({"seed": 0}, [folder], excluded=out) == before
    assert digest({"seed": 1}, [folder], excluded=out) != before
    status = image.stat()
    image.write_bytes(b"two")
    os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    assert digest({"seed": 0}, [folder], excluded=out) != before
    alone = digest({}, [image], excluded=out)
    (folder / "depth" / "camera.json").write_text("{}")
    assert digest({}, [image], excluded=out) != alone


# Saves a state after every frame, and kills itself at the n-th event (a stage, a frame, a file or
# state that is moved), or when the n-th file is moved into place.
_KILLED = """
import os, pathlib, signal, sys
from tofuse.cli import main
from tofuse.cli.progress import QuietProgress
from tofuse.pipeline import checkpoint, run
checkpoint._INTERVAL_S, checkpoint._TIME_FRACTION = 0.0, 1e9
out, last_event, last_move = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
events = moves = 0
def counted(function):
    def call(*arguments, **options):
        global events, moves
        events += 1
        moves += pathlib.Path(str(arguments[-1])).parent == out
        if events == last_event or moves == last_move:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call
QuietProgress.stage = counted(QuietProgress.stage)
QuietProgress.advance = counted(QuietProgress.advance)
os.replace = counted(os.replace)
sys.exit(main(sys.argv[4:]))
"""


def killed(out: Path, *words: object, event: int = -1, move: int = -1) -> tuple[int, str]:
    """Exit status and messages of a run that is killed."""
    job = ["run", "--out", out, *words]
    command = [sys.executable, "-c", _KILLED, out, event, move, *job]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of other systems")
def test_repeatedly_killed_run_gives_same_bytes(
    room_recording: Path, tmp_path: Path, monkeypatch
) -> None:
    whole, out = tmp_path / "whole", tmp_path / "out"
    words = (room_recording, "--every", 2, "--seed", 2, "--voxel", "5cm", "--no-report")
    assert main(["run", "--out", str(whole), *map(str, words)]) == 0
    assert {p.name for p in whole.iterdir()} == {*SAME, "run.json"}
    rng = np.random.default_rng(5)
    # In tracking or after it, and at the moves of files.
    for how in ({"event": int(rng.integers(3, 20))}, {"move": int(rng.integers(1, 8))}):
        status, message = killed(out, *words, **how)
        assert status == -signal.SIGKILL, message
        assert not (out / "run.json").exists()
    assert (out / STAGING).is_dir()
    status, message = killed(out, *words)
    assert status == 0
    assert "resumes after frame 4" in message
    assert {p.name for p in out.iterdir()} == {p.name for p in whole.iterdir()}
    for name in SAME:
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    one, other = (json.loads((f / "run.json").read_text()) for f in (whole, out))
    assert {**one, "seconds": 0} == {**other, "seconds": 0}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits of other systems")
def test_full_disk_preserves_earlier_result(
    room_recording: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    import resource

    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text('{"schema": 1, "version": "0", "verdict": "good"}')
    words = [
        "run",
        str(room_recording),
        "--out",
        str(out),
        "--every",
        "4",
        "--overwrite",
        "--no-report",
    ]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Files may not grow beyond some kilobytes: simulates a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        assert main([*words, "--overwrite"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    message = capsys.readouterr().err
    assert message.startswith(f"tofuse: {out}")
    assert "can't be written (file too large)" in message.lower()
    assert message.count("\n") == 1
    assert os.listdir(out) == ["run.json"]


def test_spilled_images_survive_checkpoint_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spill_module, "_PIECE_BYTES", 1500)
    spill: Spill[FrameSample] = Spill(2000, tmp_path)
    rng = np.random.default_rng(0)
    depths = [rng.random((30, 20)).astype(np.float16) for _ in range(8)]
    for k, depth in enumerate(depths):
        fate = np.zeros(depth.shape, np.uint8)
        spill.put(FrameSample(k, depth, fate, depth.astype(np.float32), None))
    assert spill.spilled_bytes > 5 * 1500
    states = Checkpoints(tmp_path / "out", "key", print)
    states.begin(fresh=True)
    states.save("stage", {"both": [spill, spill]})
    back = Checkpoints(tmp_path / "out", "key", print).load("stage")["both"]
    assert back[0] is back[1]
    spill.close()
    for k, depth in enumerate(depths):
        np.testing.assert_array_equal(back[0].get(k).depth, depth)
        assert back[0].get(k).color is None
    path = tmp_path / "out" / CHECKPOINT / "stage.state"
    data = bytearray(path.read_bytes())
    data[data.index(depths[0].tobytes()[:50])] ^= 1
    path.write_bytes(data)
    notes: list[str] = []
    assert Checkpoints(tmp_path / "out", "key", notes.append).load("stage") is None
    assert "damaged" in notes[0]
