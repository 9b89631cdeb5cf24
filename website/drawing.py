"""Oblique views of a result from above, with the camera trajectories."""

from __future__ import annotations

import cv2
import numpy as np

from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.lab.world import bvh_kernels as bvh

SIZE = (720, 480)  # pixels
TILT, TURN = np.radians(48.0), np.radians(62.0)
LIGHT = np.array([0.35, 0.75, -0.56])  # towards the surface, in the picture's frame
BACKGROUND = (48, 42, 38)  # BGR
ESTIMATE, TRUTH = (60, 150, 255), (235, 235, 235)
LEVELS = np.uint8(0xFC)  # noise in the lowest bits swells the file, and nobody sees it


class Picture:
    """A canvas with an oblique orthographic view from above.

    Parameters
    ----------
    shown
        (N, 3) world points that have to be in the picture.
    up
        (3,) unit vector, up in the world.
    paint
        Share of the surface's own colour: albedo of dark things hides their shape.
    """

    def __init__(self, shown: Float64, up: Float64, paint: float = 0.5) -> None:
        self.R = se3.so3_exp([TILT, 0.0, 0.0]) @ se3.so3_exp([0.0, TURN, 0.0]) @ _upright(up)
        self.paint = paint
        seen = shown @ self.R.T
        low, high = np.percentile(seen, [0.5, 99.5], axis=0)
        self.centre = (low + high) / 2
        self.scale = 0.9 * float(np.min(np.array(SIZE) / np.maximum(high - low, 1e-6)[:2]))
        self.image: UInt8 = np.empty((SIZE[1], SIZE[0], 3), np.uint8)
        self.image[:] = BACKGROUND

    def surface(self, mesh: GeometryRecord) -> None:
        """Draw the triangles whose front is to be seen: walls and ceilings don't hide the room."""
        assert mesh.faces is not None
        vertices = mesh.points.astype(float) @ self.R.T
        corners = vertices[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        front = normal[:, 2] < 0
        faces = mesh.faces[front]
        light = np.abs(normal[front] @ LIGHT) / np.maximum(
            np.linalg.norm(normal[front], axis=1), 1e-12
        )
        rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
        origins = np.stack(
            [
                (columns - SIZE[0] / 2) / self.scale + self.centre[0],
                (rows - SIZE[1] / 2) / self.scale + self.centre[1],
                np.full(rows.shape, vertices[:, 2].min() - 1.0),
            ],
            axis=-1,
        ).reshape(-1, 3)
        directions = np.broadcast_to([0.0, 0.0, 1.0], origins.shape).copy()
        triangles = vertices[faces].reshape(-1, 9)
        box, first, count, order = bvh.build_tree(triangles)
        hit, weights = np.full(len(origins), -1, np.int32), np.zeros((len(origins), 2))
        bvh.cast_rays(
            box, first, count, np.ascontiguousarray(triangles[order]),
            origins, directions, np.full(len(origins), np.inf), hit, weights,
        )  # fmt: skip
        seen = hit >= 0
        face, weights = order[hit[seen]], weights[seen]
        least = 0.3 if self.paint < 1 else 0.7  # images are lit already
        shade = least + (1 - least) * light[face]
        color = mesh.color if mesh.color is not None else np.full((len(vertices), 3), 150, np.uint8)
        at = faces[face]
        parts = np.column_stack([1 - weights.sum(axis=1), weights])
        mixed = np.einsum("nk,nkc->nc", parts, color[at].astype(float))
        mixed = self.paint * mixed + (1 - self.paint) * 190.0
        flat = self.image.reshape(-1, 3)
        flat[seen] = np.clip(mixed * shade[:, None], 0, 255)[:, ::-1].astype(np.uint8)

    def points(self, cloud: GeometryRecord) -> None:
        """Draw points as two pixels, near ones over far ones."""
        seen = cloud.points.astype(float) @ self.R.T
        order = np.argsort(-seen[:, 2], kind="stable")
        at = np.round(self._pixels(seen[order])).astype(int)
        color = cloud.color if cloud.color is not None else np.full((len(seen), 3), 170, np.uint8)
        inside = ((at >= 0) & (at < np.array(SIZE) - 1)).all(axis=1)
        u, v = at[inside].T
        for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            self.image[v + dv, u + du] = color[order][inside, ::-1]

    def path(self, poses: Float64, color: tuple[int, int, int]) -> None:
        """Draw the positions of (N, 4, 4) T_world_camera as a line, with a dot at its end."""
        at = np.round(self._pixels(poses[:, :3, 3] @ self.R.T) * 16).astype(np.int32)
        cv2.polylines(self.image, [at], False, color, 2, cv2.LINE_AA, shift=4)
        cv2.circle(self.image, tuple(at[-1].tolist()), 5 * 16, color, -1, cv2.LINE_AA, shift=4)

    def png(self) -> bytes:
        """Return the picture as a file."""
        return bytes(cv2.imencode(".png", self.image & LEVELS, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])

    def _pixels(self, seen: Float64) -> Float64:
        return (seen[:, :2] - self.centre[:2]) * self.scale + np.array(SIZE) / 2


def _upright(up: Float64) -> Float64:
    """Return the smallest rotation (3, 3) that takes `up` to -y."""
    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -float(up[1])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.diag([1.0, np.sign(cosine), np.sign(cosine)])
    return np.asarray(se3.so3_exp(np.arctan2(sine, cosine) * axis / sine))
