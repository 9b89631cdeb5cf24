"""Pixels that see planes: of a checkerboard or the wall it hangs on, or found in any scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tofuse.arrays import Bool, Float64, Intp
from tofuse.calibration.board import Board, find_corners, picture
from tofuse.calibration.board_pose import board_pose
from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.geometry.cameras import Camera, points_from_z, ray_lengths
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.recording import Recording
from tofuse.registration.plane_detection import detect_planes
from tofuse.registration.prepared_view import SurfaceOptions, prepare_view
from tofuse.sensor.noise import NoiseModel

_SEARCHED = 60  # frames at most
# A pixel on a plane is at most this far off: what the correction is for, and noise.
_ERROR_M, _SIGMAS = 0.08, 4.0
_MOST_SIGMA_M = 0.04  # noisier pixels tell little, and wrap
_LEAST_PIXELS = 200
_LEAST_COSINE = 0.3  # of incidence: at a slant, floors mirror and errors of the ray count
_RIM = 2  # pixels beside the end of a plane, which mix light
_WORST_PX = 1.0  # a board that misses its corners by more is none
# How well a board's pose is known: distance as a share and in m, tilt in rad.
_DISTANCE, _DISTANCE_M, _TILT = 5e-4, 2e-4, np.radians(0.2)
_NOTHING_KNOWN = 1e-12


@dataclass(frozen=True, eq=False)
class PlaneView:
    """One plane in one frame: the points p with ``plane . p = 1``.

    Attributes
    ----------
    frame
        Index.
    plane
        (3,) in 1/m: the normal over the distance, as known so far.
    information
        (3, 3) of it.
    pixels
        (N,) flat indices.
    measured_m, sigma_m
        (N,) radial range and its standard deviation.
    directions
        (N, 3) unit rays.
    """

    frame: int
    plane: Float64
    information: Float64
    pixels: Intp
    measured_m: Float64
    sigma_m: Float64
    directions: Float64


def board_planes(
    recording: Recording, board: Board, image: str, *, wall: bool
) -> tuple[list[PlaneView], Camera]:
    """Planes whose pose a checkerboard gives.

    Parameters
    ----------
    recording, board, image
        As for `board_views`.
    wall
        Whether the board lies flat on a wall, all of which counts; else only the board does.

    Raises
    ------
    InputError
        If the board is never seen.
    """
    noise = noise_model_for(recording)
    views, camera = [], None
    for frame in recording.images(_SEARCHED):
        camera = camera or frame.camera
        seen = picture(frame, image)
        if seen is None:
            raise InputError(
                f"frame {frame.index} has no {image} on the pixels of its depth",
                where=recording.path,
                remedy="give --image, or go by planes: leave --board out",
            )
        corners = find_corners(seen, board)
        found = None if corners is None else board_pose(frame.camera, corners, board)
        if found is None or found[1] > _WORST_PX:
            continue
        T, _ = found
        normal = T[:3, 2]
        plane = normal / (normal @ T[:3, 3])
        mask = _near(frame, plane, noise)
        if not wall:
            outline = np.concatenate([board.outline, np.zeros((4, 1))], 1)
            corner_px = frame.camera.project(se3.transform(T, outline))
            if not np.isfinite(corner_px).all():
                continue
            inside = np.zeros(mask.shape, np.uint8)
            cv2.fillConvexPoly(inside, corner_px.round().astype(np.int32), 1)
            mask &= inside.astype(bool)
        middle = se3.transform(T, board.points.astype(float)).mean(0)
        views += _view(frame, plane, _board_information(plane, middle), mask, noise)
    if camera is None or not views:
        raise InputError(
            f"shows no board of {board.columns} x {board.rows} inner corners",
            where=recording.path,
            remedy="check --board; or leave it out to go by planes",
        )
    return views, camera


def scene_planes(recording: Recording, planes: int, seed: int) -> tuple[list[PlaneView], Camera]:
    """Planes that RANSAC finds in ordinary views (Mure-Dubois and Hugli 2008).

    Parameters
    ----------
    recording
        Depth images.
    planes
        Of each view, at most.
    seed
        Of RANSAC.

    Raises
    ------
    InputError
        If there are none.
    """
    noise = noise_model_for(recording)
    views, camera = [], None
    for frame in recording.images(_SEARCHED):
        camera = camera or frame.camera
        rng = np.random.default_rng([seed, frame.index])
        taken = np.zeros(frame.depth.shape, bool)
        for found in detect_planes(
            prepare_view(frame, SurfaceOptions()),
            rng,
            max_planes=planes,
            min_share=0.1,
            thickness=0.01,
        ):
            plane = found.normal / found.offset
            mask = _near(frame, plane, noise) & ~taken
            taken |= mask
            views += _view(frame, plane, np.eye(3) * _NOTHING_KNOWN, mask, noise)
    if camera is None or not views:
        raise InputError(
            "shows no planes",
            where=recording.path,
            remedy="record a plain wall or a room, from several distances",
        )
    return views, camera


def _near(frame: RangeFrame, plane: Float64, noise: NoiseModel) -> Bool:
    """(H, W) which pixels lie on a plane, but for noise and the camera's errors."""
    points = points_from_z(frame.camera, frame.z).astype(float)
    off = np.abs(points @ plane - 1) / np.linalg.norm(plane)
    sigma = noise.sigma(frame)
    near = frame.valid & (off < _ERROR_M + _SIGMAS * sigma) & (sigma < _MOST_SIGMA_M)
    size = 2 * _RIM + 1
    # What is one surface has no holes: a rim is left out, single pixels that miss are not one.
    closed = cv2.morphologyEx(near.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inner = cv2.erode(closed, np.ones((size, size), np.uint8), borderValue=1)
    return np.asarray(near & inner.astype(bool))


def _view(
    frame: RangeFrame, plane: Float64, information: Float64, mask: Bool, noise: NoiseModel
) -> list[PlaneView]:
    sigma = noise.sigma(frame).astype(float)
    rays = frame.camera.rays().astype(float)
    pixels = np.flatnonzero(mask & (sigma > 0) & np.isfinite(rays).all(-1))
    if len(pixels) < _LEAST_PIXELS:
        return []
    own = np.concatenate([rays.reshape(-1, 2)[pixels], np.ones((len(pixels), 1))], 1)
    directions = own / ray_lengths(frame.camera).ravel()[pixels, None]
    steep = directions @ plane > _LEAST_COSINE * np.linalg.norm(plane)
    pixels, directions = pixels[steep], directions[steep]
    if len(pixels) < _LEAST_PIXELS:
        return []
    measured = frame.radial_range.astype(float).ravel()[pixels]
    sigmas = sigma.ravel()[pixels]
    return [PlaneView(frame.index, plane, information, pixels, measured, sigmas, directions)]


def _board_information(plane: Float64, middle: Float64) -> Float64:
    """(3, 3) of a plane whose distance is known at a point, and its tilt."""
    distance = float(np.linalg.norm(middle))
    axis = middle / distance
    along = (_DISTANCE + _DISTANCE_M / distance) / distance  # of plane . axis = 1 / distance
    across = _TILT * float(np.linalg.norm(plane))
    outer = np.outer(axis, axis)
    return np.asarray(outer / along**2 + (np.eye(3) - outer) / across**2)
