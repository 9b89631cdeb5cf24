"""A tiled surface on the page: each client gets the tiles for its view."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64, UInt8
from tofuse.errors import InputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import unlit_glb
from tofuse.geometry.quaternion import to_matrix
from tofuse.viewer.content import TiledLayer, merged
from tofuse.viewer.frame_budget import MAX_SHOWN_FACES, FrameBudget
from tofuse.viewer.level_of_detail import Eye, select_tiles
from tofuse.viewer.tone_mapping import inverse_tone_mapping

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

    from tofuse.files.tileset import Tile


# Fractions of the budget of triangles: if tiles must be loaded, a coarse surface is shown first.
_FRACTIONS = (0.1, 0.3, 1.0)
_MAX_LOADED_FACES = 2 * MAX_SHOWN_FACES  # including hidden tiles
_MARGIN = 0.01  # of a tile's size, within which a ray still hits it


class TiledSurface:
    """Shows a tiled surface to all clients; can be hidden and removed like a handle of viser.

    Parameters
    ----------
    server
        The server.
    layer
        The surface.
    paint
        Returns the colours (N, 3) of a tile.
    """

    def __init__(
        self,
        server: ViserServer,
        layer: TiledLayer,
        paint: Callable[[GeometryRecord], UInt8],
    ) -> None:
        self._server, self._layer, self._paint = server, layer, paint
        self._visible = True
        self._removed = False
        self._clients: dict[int, _Client] = {}
        self._lock = threading.Lock()
        for client in server.get_clients().values():
            self._join(client)
        server.on_client_connect(self._join)
        server.on_client_disconnect(self._leave)

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._visible

    @visible.setter
    def visible(self, value: bool) -> None:
        self._visible = value
        for client in self._current_clients():
            client.show(value)

    def remove(self) -> None:
        """Remove it from all clients."""
        self._removed = True
        with self._lock:
            clients, self._clients = list(self._clients.values()), {}
        for client in clients:
            client.stop(remove=True)

    def shown(self) -> list[list[Tile]]:
        """The tiles that each client shows."""
        return [client.tiles() for client in self._current_clients()]

    def layer_along(self, origin: ArrayLike, direction: ArrayLike) -> GeometryRecord:
        """Return the shown tiles that a ray hits, in the world frame."""
        R = self._layer.R_up_world
        o, d = R @ np.asarray(origin, float), R @ np.asarray(direction, float)
        hit = {t.content: t for tiles in self.shown() for t in tiles if _hits(t, o, d)}
        if not hit:
            return GeometryRecord(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
        return merged([self._layer.layer(hit[name]) for name in sorted(hit, key=str)])

    def _current_clients(self) -> list[_Client]:
        with self._lock:
            return list(self._clients.values())

    def _join(self, client: ClientHandle) -> None:
        with self._lock:
            if self._removed or client.client_id in self._clients:
                return
            self._clients[client.client_id] = _Client(
                client, self._layer, self._paint, self._visible
            )

    def _leave(self, client: ClientHandle) -> None:
        with self._lock:
            state = self._clients.pop(client.client_id, None)
        if state is not None:
            state.stop(remove=False)


class _Client:
    """One client: a thread that follows its camera.

    Tiles that are no longer shown stay loaded but hidden for a while: coarse tiles while the camera
    moves and fine ones at rest alternate on slow machines.
    """

    def __init__(
        self,
        client: ClientHandle,
        layer: TiledLayer,
        paint: Callable[[GeometryRecord], UInt8],
        visible: bool,
    ) -> None:
        self._client, self._layer, self._paint = client, layer, paint
        self._visible = visible
        self._nodes: dict[str, tuple[Tile, Any]] = {}  # the least recently used first
        self._shown: frozenset[str] = frozenset()
        self._budget = FrameBudget(layer.root.faces)
        self._last_move = -np.inf
        self._lock = threading.Lock()
        self._moved = threading.Event()
        self._stopped = False
        self._moved.set()
        client.camera.on_update(lambda _: self._on_move())
        threading.Thread(target=self._follow, name="tofuse-tiles", daemon=True).start()

    def tiles(self) -> list[Tile]:
        """The tiles that are shown."""
        with self._lock:
            return [self._nodes[name][0] for name in sorted(self._shown)]

    def show(self, visible: bool) -> None:
        """Show or hide them."""
        with self._lock:
            self._visible = visible
            for name in self._shown:
                self._nodes[name][1].visible = visible

    def stop(self, *, remove: bool) -> None:
        """End the thread."""
        with self._lock:
            self._stopped = True
            if remove:
                for _, node in self._nodes.values():
                    node.remove()
            self._nodes, self._shown = {}, frozenset()
        self._moved.set()

    def _on_move(self) -> None:
        now = time.monotonic()
        with self._lock:
            self._budget.moved(now, sum(self._nodes[name][0].faces for name in self._shown))
            self._last_move = now
        self._moved.set()

    def _follow(self) -> None:
        resting = True
        while not self._stopped:
            # At rest nothing changes; after a movement the finer surface follows.
            self._moved.wait(None if resting else self._budget.rest_s)
            self._moved.clear()
            resting = time.monotonic() - self._last_move >= self._budget.rest_s
            try:
                self._refine(self._budget.resting if resting else self._budget.moving)
            except InputError as error:  # the folder has changed
                print(f"tofuse: {error}", file=sys.stderr, flush=True)
                return

    def _refine(self, max_faces: int) -> None:
        """Show the surface at increasing detail until the camera moves again."""
        eye = self._eye()
        final = select_tiles(self._layer.root, eye, max_faces)
        if all(str(tile.content) in self._nodes for tile in final):
            self._show_tiles(final)
            return
        for fraction in _FRACTIONS:
            self._show_tiles(select_tiles(self._layer.root, eye, int(fraction * max_faces)))
            if self._stopped or self._moved.is_set():
                return

    def _eye(self) -> Eye:
        camera = self._client.camera
        R = self._layer.R_up_world
        R_up_camera = R @ to_matrix(np.roll(camera.wxyz, -1))
        return Eye(
            R @ camera.position,
            R_up_camera[:, 2],
            float(camera.fov),
            float(camera.aspect),
            int(camera.image_height),
        )

    def _show_tiles(self, tiles: list[Tile]) -> None:
        """Show these tiles and no others; new ones are added before old ones are hidden."""
        names = frozenset(str(tile.content) for tile in tiles)
        new = [tile for tile in tiles if str(tile.content) not in self._nodes]
        packed = [(tile, self._packed(tile)) for tile in new]
        with self._lock, self._client.atomic():
            if self._stopped:
                return
            for tile, data in packed:
                node = self._client.scene.add_glb(
                    f"/model/tiles/{tile.content}",
                    data,
                    visible=self._visible,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                self._nodes[str(tile.content)] = tile, node
            for name in names - self._shown:
                self._nodes[name] = self._nodes.pop(name)  # as the most recently used
                self._nodes[name][1].visible = self._visible
            for name in self._shown - names:
                self._nodes[name][1].visible = False
            self._shown = names
            self._unload()

    def _unload(self) -> None:
        """Remove hidden tiles while too many triangles are loaded."""
        loaded = sum(tile.faces for tile, _ in self._nodes.values())
        for name in [name for name in self._nodes if name not in self._shown]:
            if loaded <= _MAX_LOADED_FACES:
                return
            tile, node = self._nodes.pop(name)
            node.remove()
            loaded -= tile.faces

    def _packed(self, tile: Tile) -> bytes:
        part = self._layer.layer(tile)
        assert part.faces is not None
        return unlit_glb(part.points, part.faces, inverse_tone_mapping(self._paint(part)))


def _hits(tile: Tile, origin: Float64, direction: Float64) -> bool:
    """Whether a ray hits the box of a tile."""
    margin = _MARGIN * float(np.linalg.norm(tile.high - tile.low))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.stack([tile.low - margin, tile.high + margin]) - origin) / direction
    t_near, t_far = np.nanmin(t, 0).max(), np.nanmax(t, 0).min()
    return bool(t_far >= max(t_near, 0))
