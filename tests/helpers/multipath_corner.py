"""A corner of planes with analytic multipath."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tofuse.engine.cameras.cameras import Pinhole, ray_lengths
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.sensor.multipath import ToFImage

CAMERA = Pinhole(60, 48, 54.0, 54.0, 29.5, 23.5)


PERIOD_M = 5.0


GAIN = 900.0


HALF = np.sqrt(0.5)


# Planes n . x = d, seen from inside.
LEFT, RIGHT = ((HALF, 0.0, -HALF), -3 * HALF), ((-HALF, 0.0, -HALF), -3 * HALF)


FLOOR = ((0.0, -1.0, 0.0), -0.9)


Plane = tuple[tuple[float, float, float], float]


class Seen:
    """Planes that enclose the camera, and the light that it receives from them, by brute force.

    One bounce, between the pixels of the image alone; no shadows, as there are none in a convex
    room.
    """

    def __init__(self, *planes: Plane, albedo: float = 0.6, camera: Pinhole = CAMERA) -> None:
        self.camera = camera
        length = ray_lengths(camera).astype(float)
        directions = homogeneous(camera.rays()) / length[..., None]
        normals = np.array([n for n, _ in planes])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = np.array([d for _, d in planes])
        along = directions @ normals.T
        reach = np.where(along < -1e-9, offsets / np.minimum(along, -1e-9), np.inf)
        self.plane = reach.argmin(-1)
        self.range = reach.min(-1)
        n = normals[self.plane].reshape(-1, 3)
        d = directions.reshape(-1, 3)
        r = self.range.ravel()
        cosine = -(n * d).sum(1)
        half = length.ravel() ** -2.0
        lit = half * cosine / r**2
        x = d * r[:, None]
        area = (r**2 / cosine) / (camera.fx * camera.fy * length.ravel() ** 3)
        k = np.pi / PERIOD_M
        light = np.zeros(len(r), complex)
        for part in np.array_split(np.arange(len(r)), 40) if len(planes) > 1 else ():
            step = x[part, None] - x[None]
            square = np.maximum((step**2).sum(-1), 1e-9)
            leaving = np.clip(np.einsum("pqc,qc->pq", step, n), 0, None)
            arriving = np.clip(-np.einsum("pqc,pc->pq", step, n[part]), 0, None)
            factor = leaving * arriving * area / (square * (np.pi * square + area))
            phase = k * (np.sqrt(square) + r)
            light[part] = (factor * albedo * lit * np.exp(1j * phase)).sum(1)
        measured = lit * np.exp(2j * k * r) + light * np.exp(1j * k * r)
        shape = self.range.shape
        self.bias = (np.angle(measured * np.exp(-2j * k * r)) / (2 * k)).reshape(shape)
        self.raw = (GAIN * albedo * half * np.abs(measured)).reshape(shape)
        self.own = (GAIN * albedo * half * lit).reshape(shape)
        self.length = length

    @property
    def image(self) -> ToFImage:
        z = ((self.range + self.bias) / self.length).astype(np.float32)
        return ToFImage(z, self.camera.rays(), self.raw.astype(np.float32), PERIOD_M)

    def frame(self, **changes: object) -> RangeFrame:
        image = self.image
        frame = RangeFrame(3, 0.1, self.camera, image.z, "z", image.amplitude, ambiguity_m=PERIOD_M)
        return replace(frame, **changes)  # type: ignore[arg-type]

    def errors(self, z: np.ndarray) -> np.ndarray:
        """Error of the radial range in m."""
        return z * self.length - self.range
