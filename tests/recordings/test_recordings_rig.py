"""rig.json: round trip, and one-line errors for invalid files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.formats.rigs.rig_file import Disagreement, Rig, RigCamera, read_rig, write_rig
from tofuse.formats.rigs.rig_source import with_range_added
from tofuse.lab.world.paths import rotation

FAR = se3.translation([400, 0, 0]).tolist()


def made() -> Rig:
    T = rotation([0.1, 2.0, 0.0])
    T[:3, 3] = [0.4, 0.0, -0.1]
    return Rig(
        (
            RigCamera("left", "a/left", np.eye(4), np.zeros((6, 6))),
            RigCamera("right", "a/right", T, 1e-6 * np.eye(6), 0.0123, -0.002),
        ),
        (Disagreement("left", "right", 0.0017, 4096),),
        {"top": "no other camera sees the same"},
    )


def test_round_trip(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.json", made())
    assert read_rig(tmp_path / "rig.json").to_dict() == made().to_dict()
    assert json.loads((tmp_path / "rig.json").read_text())["schema"] == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema=2), "schema is 2"),
        (lambda d: d.pop("cameras"), "cameras: is not a list"),
        (lambda d: d["cameras"][1].update(name="left"), "two cameras called 'left'"),
        (lambda d: d["cameras"][1].update(T_rig_camera=[1, 2, 3]), "4 x 4 finite numbers"),
        (lambda d: d["cameras"][1].update(T_rig_camera=(2 * np.eye(4)).tolist()), "rotation"),
        (
            lambda d: d["cameras"][1].update(T_rig_camera=FAR),
            "is 400 m from the first .*; use metr",
        ),
        (lambda d: d["cameras"][0].update(d["cameras"][1], name="x"), "not the identity"),
        (lambda d: d["cameras"][1].update(covariance=[-1.0] + [0.0] * 35), "not a covariance"),
        (lambda d: d["cameras"][1].update(time_offset_s="soon"), "is 'soon'"),
        (lambda d: d["cameras"][1].update(depth_offset_m=1e300), "at most 10"),
        (lambda d: d["disagreement"][0].update(a="top"), "does not name two cameras"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, change, message: str) -> None:
    data = made().to_dict()
    change(data)
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message) as error:
        read_rig(path)
    assert "\n" not in str(error.value)


def test_depth_offset_is_along_ray() -> None:
    from tofuse.engine.cameras.cameras import Pinhole
    from tofuse.engine.frames.frames import RangeFrame

    camera = Pinhole(64, 48, 60.0, 60.0, 31.5, 23.5)
    frame = RangeFrame(0, 0.0, camera, np.full((48, 64), 2.0, np.float32), "z", None)
    longer = with_range_added(frame, 0.01)
    assert np.allclose(longer.radial_range - frame.radial_range, 0.01, atol=1e-5)
    assert with_range_added(frame, 0.0) is frame


def test_cameras_are_found_by_name() -> None:
    rig = made()
    assert rig.camera("right") is rig.cameras[1]
    assert rig.camera("none") is None
    assert se3.angle(replace(rig.cameras[1]).T_rig_camera) > 1.9
