"""A result as a recording of Rerun (``.rrd``): model, trajectory, and images along time."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.export.scene import Scene
from tofuse.apps.results import viridis
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.fusion import drawing
from tofuse.engine.geometry import quaternion
from tofuse.formats.files import atomic, reading
from tofuse.formats.images import jpeg_bytes

# Times in s since 1970 are shown as dates; this is in 2001.
_FIRST_DATE = 1e9
_MAX_SIGMA_PERCENTILE = 95.0
_PATH_COLOR = (90, 176, 245)


def write_rerun(scene: Scene, path: Path) -> None:
    """Write the main model of a result.

    Raises
    ------
    InputError
        If the package is not installed; see `posed_frames`.
    """
    rr = reading.required_package("rerun", "rerun", "tofuse export rerun")
    views = reading.required_package("rerun.blueprint", "rerun", "tofuse export rerun")
    name = scene.result.resolve().name
    # The viewer merges recordings of the same id, and many folders have the same name.
    digest = hashlib.sha256(scene.poses.tobytes()).hexdigest()
    recording = rr.RecordingStream("tofuse", recording_id=f"{name}-{digest[:12]}")
    recording.send_recording_name(name)
    recording.set_log_time_enabled(False)  # of the export
    recording.set_log_tick_enabled(False)
    with atomic.replacing(path) as temporary:
        recording.save(temporary, default_blueprint=_layout(views))
        _log_model(rr, recording, scene)
        for time, index, T in zip(scene.times, scene.indices, scene.poses, strict=True):
            _set_time(recording, float(time), int(index))
            recording.log("world/camera", _transform(rr, T))
        for posed in scene.images():
            _set_time(recording, posed.frame.timestamp, posed.index)
            recording.log("world/camera/depth", _pinhole(rr, posed.camera))
            recording.log("world/camera/depth", rr.DepthImage(posed.frame.depth, meter=1.0))
            if posed.image is not None:
                image = rr.EncodedImage(contents=jpeg_bytes(posed.image), media_type="image/jpeg")
                recording.log("world/camera/image", _pinhole(rr, posed.image_camera))
                recording.log("world/camera/image", image)
        recording.disconnect()


def _log_model(rr: Any, recording: Any, scene: Scene) -> None:
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("world", _transform(rr, scene.T_zup_world), static=True)
    cloud, mesh = scene.cloud, scene.mesh
    recording.log("world/cloud", rr.Points3D(cloud.points, colors=cloud.color), static=True)
    if (sigma := cloud.scalars.get("sigma")) is not None:
        recording.log("world/sigma", rr.Points3D(cloud.points, colors=_colors(sigma)), static=True)
    if mesh is not None:
        surface = rr.Mesh3D(
            vertex_positions=mesh.points,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.normals,
            vertex_colors=None if mesh.color is None else drawing.display_colors(mesh.color),
        )
        recording.log("world/mesh", surface, static=True)
    path = rr.LineStrips3D([scene.poses[:, :3, 3]], colors=[_PATH_COLOR])
    recording.log("world/trajectory", path, static=True)


def _layout(views: Any) -> Any:
    """Return the first view: the surface, without the points, beside the images."""
    model = views.Spatial3DView(contents=["+ /**", "- /world/cloud", "- /world/sigma"])
    images = [views.Spatial2DView(origin=f"world/camera/{name}") for name in ("image", "depth")]
    return views.Blueprint(
        views.Horizontal(model, views.Vertical(*images), column_shares=[3, 1]), collapse_panels=True
    )


def _set_time(recording: Any, time: float, index: int) -> None:
    recording.set_time("frame", sequence=index)
    recording.set_time("time", **{"timestamp" if time > _FIRST_DATE else "duration": time})


def _transform(rr: Any, T: Float64) -> Any:
    return rr.Transform3D(translation=T[:3, 3], quaternion=quaternion.from_matrix(T[:3, :3]))


def _pinhole(rr: Any, camera: Pinhole) -> Any:
    return rr.Pinhole(
        focal_length=(camera.fx, camera.fy),
        principal_point=(camera.cx + 0.5, camera.cy + 0.5),
        width=camera.width,
        height=camera.height,
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def _colors(sigma: Float32) -> UInt8:
    """(N, 3) colours: dark where sigma is small, yellow from its 95th percentile on."""
    finite = sigma[np.isfinite(sigma)]
    largest = float(np.percentile(finite, _MAX_SIGMA_PERCENTILE)) if len(finite) else 1.0
    return viridis(np.nan_to_num(sigma.astype(float), nan=np.inf) / (largest or 1.0))
