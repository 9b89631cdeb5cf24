"""Views of planes: a checkerboard or the wall behind it, or planes detected in any scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tofuse.apps.calibration.board import Board, board_pose, search_board
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.cameras import Camera, depth_conversion, ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.geometry import homogeneous, se3
from tofuse.engine.noise import NoiseModel, noise_model_for
from tofuse.engine.search import detect_planes
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

_MAX_FRAMES = 60  # maximum number of frames
# Largest distance of a pixel from its plane: systematic error in m, plus noise in sigmas.
_MAX_ERROR_M, _MAX_SIGMAS = 0.08, 4.0
_MAX_SIGMA_M = 0.04  # noisier pixels are uninformative, and may wrap
_MIN_PIXELS = 200
_MIN_PARALLEL = np.cos(np.radians(20.0))  # of the normals of a plane and of its pixels
_MIN_COSINE = 0.3  # of incidence: oblique floors are specular and sensitive to errors of rays
_MARGIN = 2  # width in pixels of the margin of a plane, which contains mixed pixels
_MAX_BOARD_PX = 1.0  # largest reprojection error of a detected board
# Uncertainty of a board's pose: distance (relative, and in m), tilt in rad.
_DISTANCE, _DISTANCE_M, _TILT = 5e-4, 2e-4, np.radians(0.2)
_NO_INFORMATION = 1e-12


@dataclass(frozen=True, eq=False)
class PlaneView:
    """One plane in one frame: the points p with ``plane . p = 1``.

    Attributes
    ----------
    frame
        Index of the frame.
    plane
        (3,) in 1/m: the normal divided by the distance, an initial estimate.
    information
        (3, 3) of `plane`; near 0 if its pose is unknown.
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
    """Return planes whose pose is given by a checkerboard, and the camera.

    Parameters
    ----------
    recording, board, image
        As for `board_views`.
    wall
        Whether the board lies flat on a wall, which is then used entirely; else only the board is.

    Raises
    ------
    InputError
        If the board is never detected.
    """
    noise = noise_model_for(recording)
    views, camera = [], None
    for frame, corners in search_board(recording, board, image, _MAX_FRAMES):
        camera = camera or frame.camera
        pose = None if corners is None else board_pose(frame.camera, corners, board)
        if pose is None or pose[1] > _MAX_BOARD_PX:
            continue
        T, _ = pose
        normal = T[:3, 2]
        plane = normal / (normal @ T[:3, 3])
        mask = _near_plane(frame, plane, noise)
        if wall:
            mask &= _parallel_surfaces(frame, prepare_view(frame, SurfaceOptions()), plane)
        else:
            outline = np.concatenate([board.outline, np.zeros((4, 1))], 1)
            corner_px = frame.camera.project(se3.transform(T, outline))
            if not np.isfinite(corner_px).all():
                continue
            inside = np.zeros(mask.shape, np.uint8)
            cv2.fillConvexPoly(inside, corner_px.round().astype(np.int32), 1)
            mask &= inside.astype(bool)
        centre = se3.transform(T, board.points.astype(float)).mean(0)
        views += _plane_views(frame, plane, _board_information(plane, centre), mask, noise)
    if camera is None or not views:
        raise InputError(
            f"shows no board of {board.columns} x {board.rows} inner corners",
            where=recording.path,
            remedy="check --board, or omit it to use planes of the scene",
        )
    return views, camera


def scene_planes(recording: Recording, planes: int, seed: int) -> tuple[list[PlaneView], Camera]:
    """Return planes detected by RANSAC in any views (Mure-Dubois and Hugli 2008), and the camera.

    Parameters
    ----------
    recording
        Depth images.
    planes
        Maximum number per view.
    seed
        Of RANSAC.

    Raises
    ------
    InputError
        If there are none.
    """
    noise = noise_model_for(recording)
    views, camera = [], None
    for frame in recording.images(_MAX_FRAMES):
        camera = camera or frame.camera
        rng = np.random.default_rng([seed, frame.index])
        assigned = np.zeros(frame.depth.shape, bool)
        view = prepare_view(frame, SurfaceOptions())
        found = detect_planes(view, rng, max_planes=planes, min_fraction=0.1, thickness=0.01)
        for plane in (detected.normal / detected.offset for detected in found):
            mask = _near_plane(frame, plane, noise) & _parallel_surfaces(frame, view, plane)
            mask &= ~assigned
            assigned |= mask
            views += _plane_views(frame, plane, np.eye(3) * _NO_INFORMATION, mask, noise)
    if camera is None or not views:
        raise InputError(
            "shows no planes",
            where=recording.path,
            remedy="record a plain wall or a room, from several distances",
        )
    return views, camera


def _near_plane(frame: RangeFrame, plane: Float64, noise: NoiseModel) -> Bool:
    """Return the mask (H, W) of pixels near a plane, within noise and systematic errors."""
    points = depth_conversion.points_from_z(frame.camera, frame.z).astype(float)
    distance = np.abs(points @ plane - 1) / np.linalg.norm(plane)
    sigma = noise.sigma(frame)
    near = frame.valid & (distance < _MAX_ERROR_M + _MAX_SIGMAS * sigma) & (sigma < _MAX_SIGMA_M)
    size = 2 * _MARGIN + 1
    # The margin of the surface is excluded, but not the neighbours of single missing pixels.
    closed = cv2.morphologyEx(near.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inner = cv2.erode(closed, np.ones((size, size), np.uint8), borderValue=1)
    return np.asarray(near & inner.astype(bool))


def _parallel_surfaces(frame: RangeFrame, view: PreparedView, plane: Float64) -> Bool:
    """Return the mask (H, W) of pixels on surfaces parallel to a plane.

    In a corner, the adjacent wall is close to the plane too, but on one side of it.
    """
    parallel = view.normals @ (plane / np.linalg.norm(plane)) > _MIN_PARALLEL
    height, width = frame.depth.shape
    resized = cv2.resize(
        parallel.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST
    )
    return np.asarray(resized > 0)


def _plane_views(
    frame: RangeFrame, plane: Float64, information: Float64, mask: Bool, noise: NoiseModel
) -> list[PlaneView]:
    sigma = noise.sigma(frame).astype(float)
    rays = frame.camera.rays().astype(float)
    pixels = np.flatnonzero(mask & (sigma > 0) & np.isfinite(rays).all(-1))
    directions = homogeneous(rays.reshape(-1, 2)[pixels])
    directions /= ray_lengths(frame.camera).ravel()[pixels, None]
    frontal = directions @ plane > _MIN_COSINE * np.linalg.norm(plane)
    pixels, directions = pixels[frontal], directions[frontal]
    if len(pixels) < _MIN_PIXELS:
        return []
    measured = frame.radial_range.astype(float).ravel()[pixels]
    sigmas = sigma.ravel()[pixels]
    return [PlaneView(frame.index, plane, information, pixels, measured, sigmas, directions)]


def _board_information(plane: Float64, centre: Float64) -> Float64:
    """Return the information (3, 3) of a plane with a board around the point `centre` (3,)."""
    distance = float(np.linalg.norm(centre))
    axis = centre / distance
    along = (_DISTANCE + _DISTANCE_M / distance) / distance  # of plane . axis = 1 / distance
    across = _TILT * float(np.linalg.norm(plane))
    outer = np.outer(axis, axis)
    return np.asarray(outer / along**2 + (np.eye(3) - outer) / across**2)
