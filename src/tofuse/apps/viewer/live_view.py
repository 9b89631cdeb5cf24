"""A run in the browser while it works: the growing model, the current frame, and advice."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from tofuse.apps.coach import advise_on
from tofuse.apps.report import scene, thumbnails
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.progress import OnlineMap, Progress
from tofuse.engine.results import FrameRecord

if TYPE_CHECKING:
    from viser import ViserServer


_PATH, _CURRENT, _ADVISED = (90, 176, 245), (255, 225, 90), (120, 230, 140)
_FOV = 2 * float(np.arctan(0.5))  # of the camera's pyramid as drawn
_POINTS = 4000  # of each view shown
_CLOUDS = 120  # views shown; beyond, every second one is removed
_MIN_DISTANCE, _MIN_ANGLE = 0.15, np.radians(8.0)  # m and rad between views that are shown
_UPDATE_PERIOD = 0.3  # s between updates of the current frame, and of the count
_IMAGE_WIDTH = 240  # px
# Time between questions to the coach: in s, and as a multiple of what the last one took.
_ADVICE_PERIOD, _ADVICE_SHARE = 1.0, 20.0
_ARROW_M = 0.5  # length of an arrow for a turn


class LiveView(Progress):
    """A `Progress` that shows the views at their current poses, and where to look next.

    It copies a small part of each view, so that the job is hardly slowed down and not influenced.
    It is called from one thread at a time, and raises no error because of a browser.
    """

    def __init__(self, server: ViserServer) -> None:
        self._server = server
        self._shown: list[tuple[Float64, Any]] = []
        self._path: list[Float64] = []
        self._lock = threading.Lock()
        self._stage, self._done, self._total = "opening", 0, 0
        self._last_update = self._last_status = self._next_advice = -1.0
        self._so_far: Callable[[], OnlineMap] | None = None
        self._advised: list[Any] = []  # what is drawn of the advice
        self._spacing = (_MIN_DISTANCE, _MIN_ANGLE)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction("-y")
        server.initial_camera.position = (0.6, -1.2, -2.2)
        server.initial_camera.look_at = (0.0, 0.0, 1.5)
        self._status = server.gui.add_markdown("Opening the recording.")
        self._advice = server.gui.add_markdown("")
        self._image = server.gui.add_html("")

    def stage(self, name: str, total: int | None = None) -> None:
        """See `Progress`."""
        with self._lock:
            self._stage, self._done, self._total = name, 0, total or 0
            self._so_far = None  # it would keep all views in memory
            self._show_advice("", None)
            self._show_status()

    def began(self, so_far: Callable[[], OnlineMap]) -> None:
        """See `Progress`."""
        self._so_far = so_far

    def advance(self, record: FrameRecord | None = None) -> None:
        """See `Progress`."""
        with self._lock:
            self._done += 1
            if record is not None and record.status == "lost":
                self._show_status(f"frame {record.index} is lost: {record.reason}")
            elif perf_counter() - self._last_status > _UPDATE_PERIOD:
                self._show_status()

    def note(self, text: str) -> None:
        """See `Progress`."""

    def placed(self, frame: Frame, T_world_camera: Float64) -> None:
        """See `Progress`."""
        with self._lock:
            T = np.array(T_world_camera, float)
            self._path.append(T[:3, 3])
            shown_names = {handle.name for _, handle in self._shown}
            if f"/live/{frame.index}" in shown_names or self._is_new_view(T):
                self._add(frame, T)
            now = perf_counter()
            if now - self._last_update > _UPDATE_PERIOD:
                self._last_update = now
                self._show_current(frame, T)
            if self._so_far is not None and now >= self._next_advice:
                self._advise(self._so_far(), T)
                seconds = _ADVICE_SHARE * (perf_counter() - now)
                self._next_advice = now + max(_ADVICE_PERIOD, seconds)

    def finish(self, address: str) -> None:
        """Link to the report of the result, which is served at an address."""
        with self._lock:
            self._status.content = f"**Finished.** [The report]({address})"

    def _show_status(self, detail: str = "") -> None:
        self._last_status = perf_counter()
        words = f"**{self._stage}**"
        if self._total:
            words += f" {self._done} of {self._total}"
        elif self._done:
            words += f" {self._done}"
        self._status.content = f"{words}\n\n{_escaped(detail)}" if detail else words

    def _advise(self, so_far: OnlineMap, T: Float64) -> None:
        try:
            advice = advise_on(so_far)
        except np.linalg.LinAlgError:  # of poses that are hardly measured yet; the job goes on
            return
        if advice is None:
            return
        target = advice.T_world_camera
        if target is not None:  # loops have moved the latest pose in one of the two worlds
            target = T @ se3.inverse(so_far.graph.poses[-1]) @ target
        words = f"**Next:** {_escaped(advice.words)}"
        if advice.gain_m:
            words += "\n\n(the 95 % bound on the errors of the poses, now and after that)"
        self._show_advice(words, target, T)

    def _show_advice(self, words: str, target: Float64 | None, T: Float64 | None = None) -> None:
        """Show words, and an arrow from the camera's pose T to a target."""
        self._advice.content = words
        for handle in self._advised:
            handle.remove()
        self._advised = []
        if target is None or T is None:
            return
        start, step = T[:3, 3], target[:3, 3] - T[:3, 3]
        end = start + (step if np.linalg.norm(step) > _MIN_DISTANCE else _ARROW_M * target[:3, 2])
        arrow = np.stack([start, end])[None].astype(np.float32)
        self._advised = [
            self._server.scene.add_arrows(
                "/live_advice",
                arrow,
                _ADVISED,
                shaft_radius=0.025,
                head_radius=0.08,
                head_length=0.2,
            ),
            self._draw_camera("/live_target", target, 1.25, _ADVISED),
        ]

    def _draw_camera(
        self, name: str, T: Float64, aspect: float, color: tuple[int, int, int]
    ) -> Any:
        """Draw the pyramid of a camera at pose T (4, 4)."""
        return self._server.scene.add_camera_frustum(
            name,
            _FOV,
            aspect,
            scale=0.15,
            thickness=2.5,
            thickness_units="screen",
            color=color,
            wxyz=np.roll(quaternion.from_matrix(T[:3, :3]), 1),
            position=T[:3, 3],
        )

    def _is_new_view(self, T: Float64) -> bool:
        if not self._shown:
            return True
        motions = se3.inverse(T) @ np.stack([pose for pose, _ in self._shown])
        distant = np.linalg.norm(motions[:, :3, 3], axis=1) > self._spacing[0]
        return bool((distant | (se3.angle(motions) > self._spacing[1])).all())

    def _add(self, frame: Frame, T: Float64) -> None:
        points = frame.points
        if len(points) == 0:
            return
        sampled = slice(None, None, -(-len(points) // _POINTS))
        world = se3.transform(T, points[sampled].astype(float)).astype(np.float32)
        colors = scene.height_colors(world.astype(float))
        if frame.color is not None:
            colors = frame.color[sampled]
        elif frame.amplitude is not None:
            colors = thumbnails.grey(frame.amplitude[None, sampled])[0]
        handle = self._server.scene.add_point_cloud(
            f"/live/{frame.index}",
            world,
            colors,
            point_size=0.012,
            point_shading="flat",
            precision="float16",
        )
        self._shown = [item for item in self._shown if item[1].name != handle.name]
        self._shown.append((T, handle))
        if len(self._shown) > _CLOUDS:
            for _, removed in self._shown[1::2]:
                removed.remove()
            del self._shown[1::2]
            self._spacing = (1.5 * self._spacing[0], 1.5 * self._spacing[1])

    def _show_current(self, frame: Frame, T: Float64) -> None:
        image = None
        if isinstance(frame, RangeFrame):
            frame_image = frame.color_image
            if frame_image is None:
                frame_image = thumbnails.depth_image(frame)
            image = thumbnails.subsample(frame_image, _IMAGE_WIDTH)
            source = thumbnails.data_uri(image, jpeg=True)
            self._image.content = (
                f'<img alt="The frame" src="{source}" style="width:100%;padding:0 0.6em">'
            )
        aspect = 1.25 if image is None else image.shape[1] / image.shape[0]
        self._draw_camera("/live_camera", T, aspect, _CURRENT)
        path = np.stack(self._path[:: -(-len(self._path) // 2000)])
        if len(path) > 1:
            ends = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
            self._server.scene.add_line_segments(
                "/live_path", ends, _PATH, thickness=2.0, thickness_units="screen"
            )


def _escaped(text: str) -> str:
    """Return text, which may quote a file, so that Markdown shows it as it is."""
    return re.sub(r"([\\`*_{}\[\]<>()#+!|~&-])", r"\\\1", text)
