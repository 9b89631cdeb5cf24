"""Simulated scenes: surfaces for ray casting, and the motion of camera and object.

A scene is given in its room's frame (z up, the floor at 0). Moving bodies have their own frames and
trees: the recorded object, and distractors that pass by.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float32, Float64, Int32, Int64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.lab.world import bvh_kernels as bvh
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world import texture
from tofuse.lab.world.mesh import Mesh
from tofuse.lab.world.paths import Path
from tofuse.lab.world.shading_kernels import Rays, Shading, Textures, Triangles, shade_hits
from tofuse.lab.world.texture import Material

# Small enough to occupy all threads, large enough to amortise the overhead of a chunk.
_RAYS_PER_CHUNK = 4096


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays.

    Attributes
    ----------
    distance
        (N,) float32, m along the unit direction, infinite where nothing is hit.
    normal
        (N, 3) float32, unit, facing the origin of the ray, in the room's frame; 0 without a hit.
    albedo
        (N,) float32, near-infrared diffuse reflectance 0 to 1 at the hit.
    gloss
        (N,) float32, fraction of the light that is reflected specularly, 0 to 1.
    surface
        (N,) int32, index into `Scene.materials`, -1 without a hit.
    """

    distance: Float32
    normal: Float32
    albedo: Float32
    gloss: Float32
    surface: Int32


class Body:
    """A mesh with its tree for ray casting."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        triangles = mesh.corners().reshape(-1, 9)
        self._box, self._first, self._count, order = bvh.build_tree(triangles)
        self._triangles = np.ascontiguousarray(triangles[order])
        self._corner_normals = np.ascontiguousarray(
            meshes.corner_normals(mesh)[order].reshape(-1, 9)
        )
        self._face_normals = np.ascontiguousarray(meshes.face_normals(mesh)[order])
        self._surface = mesh.surface[order].astype(np.int32)

    def cast(
        self, origins: Float64, directions: Float64, distance: Float64
    ) -> tuple[Int32, Float64]:
        """Reduce `distance` (N,) where the body is nearer; return faces (-1: none) and weights."""
        face = np.full(len(directions), -1, np.int32)
        weights = np.zeros((len(directions), 2))
        bvh.cast_rays(
            self._box, self._first, self._count, self._triangles,
            origins, directions, distance, face, weights,
        )  # fmt: skip
        return face, weights

    def shade(self, textures: Textures, rays: Rays, R_room_body: Float64, out: Shading) -> None:
        """Fill in normal, albedo, gloss and surface of the rays that hit this body."""
        triangles = Triangles(self._corner_normals, self._face_normals, self._surface)
        shade_hits(triangles, textures, rays, R_room_body, out)


class Scene:
    """Surfaces for ray casting.

    Attributes
    ----------
    name
        As in `SCENES`.
    ambient
        Ambient infrared light, 0 (dark room) to 1 (bright office).
    max_depth_m
        Depth beyond which `--object` removes the background; None without a moving object.
    materials
        One for each surface id.
    """

    def __init__(
        self,
        name: str,
        materials: SequenceOf[Material],
        room: Mesh,
        moving: Mesh | None = None,
        *,
        ambient: float = 0.3,
        max_depth_m: float | None = None,
        seed: int = 0,
    ) -> None:
        self.name = name
        self.ambient = ambient
        self.max_depth_m = max_depth_m
        self.materials = tuple(materials)
        self._room = Body(room)
        self._object = None if moving is None else Body(moving)
        self._passing: tuple[Body, ...] = ()
        self._seed = seed
        self._rows = texture.parameter_rows(self.materials, seed)
        self._noise = texture.noise_tables(seed)

    def with_passing(self, materials: SequenceOf[Material], meshes: SequenceOf[Mesh]) -> Self:
        """Return the scene with additional bodies that move through it.

        Parameters
        ----------
        materials
            Of the new bodies; their ids follow those of the scene.
        meshes
            One for each body, in its own frame; surface ids index `materials`.
        """
        scene = copy.copy(self)
        first = len(self.materials)
        scene.materials = (*self.materials, *materials)
        scene._passing = (
            *self._passing,
            *(Body(replace(mesh, surface=mesh.surface + first)) for mesh in meshes),
        )
        scene._rows = texture.parameter_rows(scene.materials, self._seed)
        return scene

    def with_surface(self, material: Material, mesh: Mesh) -> Self:
        """Return the scene with one more surface in its room, a mirror for example."""
        scene = copy.copy(self)
        room = self._room.mesh
        scene._room = Body(meshes.joined([room, mesh.of_surface(len(self.materials))]))
        scene.materials = (*self.materials, material)
        scene._rows = texture.parameter_rows(scene.materials, self._seed)
        return scene

    @property
    def _moving(self) -> tuple[Body, ...]:
        """All moving bodies, the object first."""
        return self._passing if self._object is None else (self._object, *self._passing)

    @property
    def passing_surfaces(self) -> frozenset[int]:
        """Surface ids of the passing bodies."""
        return frozenset(int(k) for body in self._passing for k in np.unique(body.mesh.surface))

    @property
    def triangles(self) -> int:
        """Number of triangles, of all bodies together."""
        return sum(len(body.mesh.faces) for body in (self._room, *self._moving))

    def cast(
        self, origins: ArrayLike, directions: ArrayLike, T_room_bodies: ArrayLike | None = None
    ) -> Hits:
        """Return the first hit of each ray.

        Parameters
        ----------
        origins
            (N, 3), or (3,) for all, in m in the room's frame. A ray that starts on a surface may
            hit it again: offset it by 0.1 mm along the normal.
        directions
            (N, 3) unit vectors in the room's frame.
        T_room_bodies
            (B, 4, 4) poses of the moving bodies, the object first; (4, 4) for a single one.
            Identity if not given.
        """
        directions = np.asarray(directions)
        origins = np.atleast_2d(np.asarray(origins))
        size = len(directions)
        if origins.shape not in ((1, 3), (size, 3)) or directions.shape != (size, 3):
            raise ValueError(f"rays of shapes {origins.shape} and {directions.shape}")
        bodies = self._moving
        if T_room_bodies is None:
            T_room_bodies = np.tile(np.eye(4), (len(bodies), 1, 1))
        poses = np.asarray(T_room_bodies, float).reshape(-1, 4, 4)
        if len(poses) != len(bodies):
            raise ValueError(f"{len(poses)} poses for {len(bodies)} moving bodies")
        distance = np.empty(size, np.float32)
        normal = np.zeros((size, 3), np.float32)
        albedo = np.zeros(size, np.float32)
        gloss = np.zeros(size, np.float32)
        surface = np.full(size, -1, np.int32)

        def chunk(a: int, b: int) -> None:
            rays = np.ascontiguousarray(directions[a:b], np.float64)
            room_origins = np.ascontiguousarray(
                origins if len(origins) != size else origins[a:b], np.float64
            )
            nearest = np.full(b - a, np.inf)
            out = Shading(normal[a:b], albedo[a:b], gloss[a:b], surface[a:b])
            face, weights = self._room.cast(room_origins, rays, nearest)
            textures = Textures(self._rows, *self._noise)
            hits = Rays(room_origins, rays, nearest, face, weights)
            self._room.shade(textures, hits, np.eye(3), out)
            for body, T in zip(bodies, poses, strict=True):
                T_body_room = se3.inverse(T)
                body_origins = np.ascontiguousarray(se3.transform(T_body_room, room_origins))
                body_directions = np.ascontiguousarray(rays @ T_body_room[:3, :3].T)
                face, weights = body.cast(body_origins, body_directions, nearest)
                R = np.ascontiguousarray(T[:3, :3])
                hits = Rays(body_origins, body_directions, nearest, face, weights)
                body.shade(textures, hits, R, out)
            distance[a:b] = nearest

        run_chunks(chunk, size, chunks=max(1, size // _RAYS_PER_CHUNK))
        return Hits(distance, normal, albedo, gloss, surface)

    def truth_mesh(self) -> tuple[Float64, Int64]:
        """Return the true surface: vertices (V, 3) in m and faces (F, 3).

        It is the moving object in its own frame if there is one, else the room in its frame.
        `Sequence.T_world_truth` maps either into the recording's world.
        """
        body = self._room if self._object is None else self._object
        return body.mesh.vertices, body.mesh.faces


@dataclass(frozen=True, eq=False)
class Sequence:
    """Motion of camera and bodies.

    Attributes
    ----------
    frames
        Number of raw frames.
    stride
        The thesis used every `stride`-th raw frame.
    frame_rate_hz
        Raw frames per second; frame k is at time k / frame_rate_hz.
    camera_path, object_path
        Poses in the room as functions of time in s; `object_path` is None if only the camera moves.
    passing_paths
        Poses in the room of the passing bodies, in the scene's order. Camera poses are never
        relative to them.
    """

    frames: int
    stride: int
    frame_rate_hz: float
    camera_path: Path = field(repr=False)
    object_path: Path | None = field(default=None, repr=False)
    passing_paths: tuple[Path, ...] = field(default=(), repr=False)

    def selected(self, every: int | None = None, frames: int | None = None, first: int = 0) -> Intp:
        """Return the indices of every `every`-th raw frame from `first` on, at most `frames`.

        Raises
        ------
        InputError
            For a stride or number of frames below 1, or a first frame out of range.
        """
        stride = self.stride if every is None else every
        for name, value in (("every", stride), ("frames", 1 if frames is None else frames)):
            if value < 1:
                raise InputError(f"is {value}", where=name, remedy="use 1 or more")
        if not 0 <= first < self.frames:
            raise InputError(
                f"is {first}", where="--first", remedy=f"use one from 0 to {self.frames - 1}"
            )
        return np.arange(first, self.frames, stride)[:frames]

    def T_room_camera(self, t: float) -> Float64:
        """(4, 4) pose of the camera in the room at time t in s."""
        return self.camera_path(t)

    def T_room_object(self, t: float) -> Float64 | None:
        """(4, 4) pose of the object in the room at time t in s; None if there is no object."""
        return None if self.object_path is None else self.object_path(t)

    def with_passing(self, passing: SequenceOf[Path]) -> Self:
        """Return the sequence with the paths of additional passing bodies."""
        return replace(self, passing_paths=(*self.passing_paths, *passing))

    def T_room_bodies(self, t: float) -> Float64 | None:
        """(B, 4, 4) poses of the bodies at time t in s, the object first; None without bodies."""
        paths = self.passing_paths
        if self.object_path is not None:
            paths = (self.object_path, *paths)
        return np.stack([path(t) for path in paths]) if paths else None

    def T_world_camera(self, t: float, first: float = 0.0) -> Float64:
        """(4, 4) true pose of the camera in the recording's world at time t in s.

        The world is the moving object if there is one, else the room; its frame is the camera's at
        time `first`, so the pose at `first` is the identity.
        """
        # Exactly the identity; the product has rounding errors.
        return np.eye(4) if t == first else self.T_world_truth(first) @ self._T_subject_camera(t)

    def T_world_truth(self, first: float = 0.0) -> Float64:
        """(4, 4) transform of `Scene.truth_mesh` into the recording's world."""
        return se3.inverse(self._T_subject_camera(first))

    def _T_subject_camera(self, t: float) -> Float64:
        T_room_object = self.T_room_object(t)
        T_room_camera = self.T_room_camera(t)
        return (
            T_room_camera if T_room_object is None else se3.inverse(T_room_object) @ T_room_camera
        )


@dataclass(frozen=True)
class SceneKind:
    """One entry of `SCENES`.

    Attributes
    ----------
    summary
        Content and motion of the scene.
    module
        Module of `tofuse.lab.scenes` that builds it.
    frames, stride
        Number of raw frames of the whole sequence, and the thesis's stride.
    """

    summary: str
    module: str
    frames: int
    stride: int


SCENES: dict[str, SceneKind] = {
    "room": SceneKind("one turn in a room with seven office chairs", "room", 384, 3),
    "empty-room": SceneKind("one turn in the same room, empty", "room", 405, 3),
    "rail": SceneKind("0.90 m to the side and back, facing an office desk", "rail", 315, 5),
    "torso": SceneKind("a person on a rotating chair, one turn", "torso", 222, 6),
    "box": SceneKind("a box of 300 x 300 x 400 mm on a stand, one turn", "box", 570, 10),
    "wall": SceneKind("one flat wall, swaying in front of it", "plain", 60, 3),
    "corner": SceneKind("three planes that meet, swaying in front of them", "plain", 60, 3),
    "flat": SceneKind("a walk of 22 m through four rooms of a flat", "flat", 1140, 3),
    "flat-alike": SceneKind("the same walk where the four rooms look alike", "flat", 1140, 3),
    "hall": SceneKind("a hall of 8 x 8 m, larger than some cameras' period", "plain", 180, 6),
    "corridor": SceneKind("1.5 m forward along a corridor", "plain", 60, 3),
    "checkerboard": SceneKind(
        "a board of 8 x 6 corners, 100 mm, on a wall, from 32 places", "checkerboard", 2880, 90
    ),
}

FRAME_RATE_HZ = 30.0


@dataclass(frozen=True)
class SceneOptions:
    """Options of a scene's builder: the arguments of `build`."""

    name: str
    seed: int
    seconds: float


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """Output of a scene's builder, from which `build` makes a scene and a sequence."""

    materials: SequenceOf[Material]
    room: Mesh
    camera_path: Path
    moving: Mesh | None = None
    object_path: Path | None = None
    ambient: float = 0.3
    max_depth_m: float | None = None


def build(name: str, *, seed: int = 0, texture: bool = True) -> tuple[Scene, Sequence]:
    """Build a scene and its sequence.

    Parameters
    ----------
    name
        One of `SCENES`.
    seed
        Seed of the textures and of the furniture's orientation.
    texture
        False gives every surface the same matte albedo.

    Raises
    ------
    InputError
        For an unknown name.
    """
    kind = SCENES.get(name)
    if kind is None:
        raise InputError(
            f"there is no scene {name!r}", where="scene", remedy=f"use one of {', '.join(SCENES)}"
        )
    options = SceneOptions(name, seed, kind.frames / FRAME_RATE_HZ)
    plan: ScenePlan = importlib.import_module(f"tofuse.lab.scenes.{kind.module}").plan(options)
    scene = Scene(
        name,
        plan.materials if texture else [m.uniform() for m in plan.materials],
        plan.room,
        plan.moving,
        ambient=plan.ambient,
        max_depth_m=plan.max_depth_m,
        seed=seed,
    )
    sequence = Sequence(kind.frames, kind.stride, FRAME_RATE_HZ, plan.camera_path, plan.object_path)
    return scene, sequence
