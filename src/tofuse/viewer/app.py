"""The page of a result: model, cameras, frames, and distance measurement."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, Float64, UInt8
from tofuse.errors import InputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import linear, unlit_glb
from tofuse.geometry.quaternion import from_matrix
from tofuse.normal import OF_95_PERCENT
from tofuse.report.fields import Field
from tofuse.report.pictures import FATES, KINDS, Pictures
from tofuse.report.scene import MAX_CAMERAS, RigCameras, camera_lines, spacing_of
from tofuse.report.thumbnails import viridis
from tofuse.report.words import frame_range
from tofuse.results.card import length
from tofuse.results.folder import component_name, is_result
from tofuse.viewer.content import (
    ViewContent,
    colorings,
    layer_colors,
    read_content,
)
from tofuse.viewer.picking import pick
from tofuse.viewer.tiled import TiledSurface
from tofuse.viewer.tone_mapping import inverse_tone_mapping

if TYPE_CHECKING:
    from viser import GuiEvent, SceneClickEvent, ViserServer


BEFORE, AFTER, LOOPS, CHOSEN = (240, 160, 60), (90, 176, 245), (95, 208, 138), (255, 225, 90)
FOV = 2 * float(np.arctan(0.5))  # of camera frusta as drawn
_REASONS = 4
_MAX_EXTENT_RATIO = 1.8  # cameras are not framed if that enlarges the model's box more


class ResultView:
    """Shows a result on a server.

    Attributes
    ----------
    ends
        The picked points (3,), at most two.
    distance, error
        Distance between the last two picked points, and the 95 % bound of its error, m; None
        before there are two, NaN where the errors of the points are unknown.
    """

    def __init__(self, server: ViserServer, result: ViewContent) -> None:
        self.ends: list[Float64] = []
        self.distance: float | None = None
        self.error: float | None = None
        self._sigmas: list[float] = []
        self._server, self._result = server, result
        self._lock = threading.Lock()
        self._measuring = False
        layers = [la for la in (result.mesh, result.cloud) if la is not None]
        self._scale = _place_camera(server, result)
        self._coloring = (colorings(layers) or ["height"])[0]
        self._model: dict[str, Any] = {}
        server.gui.main_panel.dock_right()
        with server.atomic():
            self._show_verdict()
            self._add_models()
            self._add_lines()
            self._add_toggles(colorings(layers))
            self._add_frames()
            self._add_measure()
            self._paint()

    def _show_verdict(self) -> None:
        run = self._result.run
        lines = [f"**{str(run['verdict']).capitalize()}**"]
        reasons = list(dict.fromkeys(r["text"] for r in run["reasons"]))
        lines += [f"- {_escape_markdown(text)}" for text in reasons[:_REASONS]]
        if len(reasons) > _REASONS:
            lines.append(f"- {len(reasons) - _REASONS} more in report.html")
        self._server.gui.add_markdown("\n".join(lines))

    def _add_models(self) -> None:
        """Add a choice of models, if components have their own."""
        folder, gui = self._result.folder, self._server.gui
        main = folder.parent if folder.name.startswith("component-") else folder
        if not is_result(main):
            main = folder
        models = {"main model": main} | {
            component_name(k): main / component_name(k)
            for k, c in enumerate(self._result.run["components"] if main == folder else ())
            if is_result(main / component_name(k))
        }
        if main != folder:
            models |= {p.name: p for p in sorted(main.glob("component-*")) if is_result(p)}
        if len(models) < 2:
            return
        current = next(name for name, path in models.items() if path == folder)
        choice = gui.add_dropdown("Model", tuple(models), initial_value=current)
        frames = [f["index"] for f in self._result.frames]
        if frames and current != "main model":
            gui.add_markdown(f"Its frames: {frame_range(min(frames), max(frames))}.")

        @choice.on_update
        def _(event: GuiEvent[Any]) -> None:
            path = models[str(event.target.value)]
            try:
                other = read_content(path)
            except InputError as error:
                self._legend.content = _escape_markdown(str(error))
                return
            with self._server.atomic():
                self._server.scene.reset()
                self._server.gui.reset()
                ResultView(self._server, other)

    def _add_lines(self) -> None:
        result, scene = self._result, self._server.scene
        edge = 0.018 * self._scale
        self._lines = {}
        for name, poses, color in (
            ("after", result.after, AFTER),
            ("before", result.view.before, BEFORE),
        ):
            if not poses:
                continue
            ends, colors = _camera_segments(poses, edge, color, result if name == "after" else None)
            self._lines[name] = scene.add_line_segments(
                f"/cameras/{name}",
                ends,
                colors,
                thickness=1.6,
                thickness_units="screen",
                visible=name == "after",
            )
        if len(result.loops):
            self._lines["loops"] = scene.add_line_segments(
                "/loops",
                result.loops.astype(np.float32),
                LOOPS,
                thickness=2.0,
                thickness_units="screen",
            )

    def _add_toggles(self, choices: list[str]) -> None:
        gui, result = self._server.gui, self._result
        with gui.add_folder("Show"):
            self._layer_toggles = {}
            self._line_toggles: dict[str, Any] = {}
            has_surface = result.mesh is not None and len(result.mesh.points) > 0
            if has_surface:
                self._layer_toggles["surface"] = gui.add_checkbox("Surface", True)
            self._layer_toggles["points"] = gui.add_checkbox("Points", not has_surface)
            if result.view.model_before is not None:
                self._layer_toggles["model before"] = gui.add_checkbox(
                    "Points before optimisation", False
                )
            for handle in self._layer_toggles.values():
                handle.on_update(self._repaint)
            for name, label in (
                ("after", "Cameras"),
                ("before", "Cameras before"),
                ("loops", "Loop closures"),
            ):
                if name in self._lines:
                    checkbox = gui.add_checkbox(label, name == "after" or name == "loops")
                    checkbox.on_update(self._toggle_lines(name))
                    self._line_toggles[name] = checkbox
            rig = result.rig
            if rig is not None:
                gui.add_html(_rig_legend(rig))
            if len(choices) > 1:
                self._choice = gui.add_dropdown("Colour by", choices, initial_value=self._coloring)
                self._choice.on_update(self._recolor)
            self._legend = gui.add_html("")

    def _toggle_lines(self, name: str) -> Any:
        def toggle(event: GuiEvent[Any]) -> None:
            self._lines[name].visible = bool(event.target.value)

        return toggle

    def _repaint(self, _: GuiEvent[Any]) -> None:
        with self._lock:
            self._paint()

    def _recolor(self, event: GuiEvent[Any]) -> None:
        with self._lock:
            self._coloring = str(event.target.value)
            for handle in self._model.values():
                handle.remove()
            self._model.clear()
            self._paint()

    def _visible_layers(self) -> dict[str, GeometryRecord]:
        """The visible layers of the model, by name."""
        layers = {
            "surface": self._result.mesh,
            "points": self._result.cloud,
            "model before": self._result.view.model_before,
        }
        return {
            name: layer
            for name, layer in layers.items()
            if layer is not None and name in self._layer_toggles and self._layer_toggles[name].value
        }

    def _paint(self) -> None:
        """Show the visible layers; those that clients already have are not sent again."""
        visible = self._visible_layers()
        for name, handle in self._model.items():
            handle.visible = name in visible
        scale: Field | None = None
        for name, layer in visible.items():
            coloring = "colour" if name == "model before" else self._coloring
            colors, field = layer_colors(layer, coloring, self._result.up)
            scale = field or scale
            if name not in self._model and len(layer.points):
                self._model[name] = self._add_layer(name, layer, colors)
        self._legend.content = "" if scale is None else color_bar(scale.label, scale.labels)

    def _add_layer(self, name: str, layer: GeometryRecord, colors: UInt8) -> Any:
        scene = self._server.scene
        if name == "surface" and self._result.tiles is not None:
            coloring, up = self._coloring, self._result.up
            return TiledSurface(
                self._server,
                self._result.tiles,
                lambda part: layer_colors(part, coloring, up, layer)[0],
            )
        if layer.faces is None:
            return scene.add_point_cloud(
                f"/model/{name}",
                layer.points,
                colors,
                point_size=_point_size(layer.points),
                precision="float32",
                point_shape="circle",
                point_shading="flat",
            )
        surface = unlit_glb(layer.points, layer.faces, inverse_tone_mapping(colors))
        return scene.add_glb(f"/model/{name}", surface, cast_shadow=False, receive_shadow=False)

    def _add_frames(self) -> None:
        result, gui = self._result, self._server.gui
        self._camera: Any = None
        if not result.frames:
            return
        with gui.add_folder("Frame"):
            last = max(len(result.frames) - 1, 1)
            self._slider = gui.add_slider("Frame", 0, last, 1, 0)
            self._slider.on_update(self._on_slider)
            self._status = gui.add_markdown("")
            look = gui.add_button("Look through this camera")
            look.on_click(self._look_through)
            self._images = gui.add_html("")
        self._show_frame(0)

    def _on_slider(self, event: GuiEvent[Any]) -> None:
        with self._lock, self._server.atomic():
            self._show_frame(int(event.target.value))

    def _show_frame(self, row: int) -> None:
        result = self._result
        frame = result.frames[min(row, len(result.frames) - 1)]
        index = frame["index"]
        words = f"Frame {index}: **{frame['status']}**"
        if frame["reason"]:
            words += f" – {_escape_markdown(frame['reason'])}"
        picture = _nearest(result.view.pictures, index)
        if picture is not None:
            self._images.content = _images_html(picture)
            if picture.index != index:
                words += f"\n\nThe images are of frame {picture.index}, the nearest one stored."
        self._status.content = words
        if self._camera is not None:
            self._camera.remove()
            self._camera = None
        T = result.after.get(index)
        if T is None:
            return
        image = None
        if picture is not None and picture.index == index:
            image = decoded(picture.images.get("color") or picture.images["range"])
        self._camera = self._server.scene.add_camera_frustum(
            "/cameras/chosen",
            FOV,
            1.25 if image is None else image.shape[1] / image.shape[0],
            scale=0.05 * self._scale,
            thickness=2.5,
            thickness_units="screen",
            color=CHOSEN,
            image=image,
            wxyz=wxyz(T),
            position=T[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
        )

    def _look_through(self, event: GuiEvent[Any]) -> None:
        row = min(int(self._slider.value), len(self._result.frames) - 1)
        T = self._result.after.get(self._result.frames[row]["index"])
        if T is None or event.client is None:
            return
        # Camera frusta would occlude the model.
        if self._camera is not None:
            self._camera.visible = False
        for checkbox in self._line_toggles.values():
            checkbox.value = False
        event.client.camera.wxyz = wxyz(T)
        event.client.camera.position = T[:3, 3]

    def _add_measure(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Distance"):
            self._button = gui.add_button("Pick two points")
            self._button.on_click(self._begin_measuring)
            self._measured = gui.add_markdown("")

    def _begin_measuring(self, _: GuiEvent[Any]) -> None:
        with self._lock:
            self.ends.clear()
            self._sigmas.clear()
            for name in ("/distance/0", "/distance/1", "/distance/line", "/distance/label"):
                self._server.scene.remove_by_name(name)
            if not self._measuring:
                self._measuring = True
                self._server.scene.on_click()(self._clicked)
            self._measured.content = "Click the first point."

    def _clicked(self, event: SceneClickEvent) -> None:
        with self._lock:
            if not self._measuring:
                return
            layers = self._visible_layers()
            tiled = self._model.get("surface")
            if "surface" in layers and isinstance(tiled, TiledSurface):
                layers["surface"] = tiled.layer_along(event.ray_origin, event.ray_direction)
            picked = pick(list(layers.values()), event.ray_origin, event.ray_direction)
            if picked is None:
                self._measured.content = "No surface there: click the model."
                return
            point = picked.point
            scene = self._server.scene
            scene.add_icosphere(
                f"/distance/{len(self.ends)}",
                0.006 * self._scale,
                color=CHOSEN,
                position=point,
                cast_shadow=False,
                receive_shadow=False,
            )
            self.ends.append(point)
            self._sigmas.append(picked.sigma)
            if len(self.ends) == 1:
                self._measured.content = "Click the second point."
                return
            self._measuring = False
            scene.remove_click_callback(self._clicked)
            a, b = self.ends
            self.distance = float(np.linalg.norm(b - a))
            self.error = OF_95_PERCENT * float(np.linalg.norm(self._sigmas))
            text = _length(self.distance)
            if np.isfinite(self.error):
                text += f" ± {length(self.error)}"
            ends = np.stack([a, b])[None].astype(np.float32)
            scene.add_line_segments(
                "/distance/line", ends, CHOSEN, thickness=3.0, thickness_units="screen"
            )
            scene.add_label("/distance/label", text, position=(a + b) / 2)
            self._measured.content = f"**{text}**"


def _camera_segments(
    poses: dict[int, Float64], edge: float, color: tuple[int, int, int], content: ViewContent | None
) -> tuple[Float32, Any]:
    """Line segments (L, 2, 3) of camera frusta, and their colours; for a rig, one per camera."""
    rig = None if content is None else content.rig
    if content is None or rig is None:
        all_poses = np.stack([poses[k] for k in sorted(poses)])
        step = -(-len(all_poses) // MAX_CAMERAS)
        return camera_lines(all_poses, edge, step).reshape(-1, 2, 3).astype(np.float32), color
    camera = dict(zip((f["index"] for f in content.frames), rig.of_frames.tolist(), strict=True))
    # viser expects linear colours per vertex, but sRGB for a single colour.
    linear_colors = (linear(np.array(rig.colors, np.uint8))[:, :3] // 257).astype(np.uint8)
    ends, colors = [], []
    for number in range(len(rig.names)):
        camera_poses = [poses[k] for k in sorted(poses) if camera[k] == number]
        if not camera_poses:
            continue
        step = -(-len(camera_poses) * len(rig.names) // MAX_CAMERAS)
        lines = camera_lines(np.stack(camera_poses), edge, step).reshape(-1, 2, 3)
        ends.append(lines)
        colors.append(np.broadcast_to(linear_colors[number], lines.shape))
    return np.concatenate(ends).astype(np.float32), np.concatenate(colors)


def _rig_legend(rig: RigCameras) -> str:
    """The names of a rig's cameras with their colours, as HTML."""
    square = "display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:6px"
    rows = (
        f'<div style="overflow-wrap:anywhere"><i style="{square};background:rgb{color}"></i>'
        f"{escape(name)}</div>"
        for name, color in zip(rig.names, rig.colors, strict=True)
    )
    return f'<div style="padding:0 0.8em 0.5em;font-size:0.85em">{"".join(rows)}</div>'


def _place_camera(server: ViserServer, result: ViewContent) -> float:
    """Look at the model from above and to the side; return its size in m."""
    layer = result.mesh if result.mesh is not None and len(result.mesh.points) else result.cloud
    points = layer.points if len(layer.points) else np.zeros((1, 3), np.float32)
    low, high = np.percentile(points[:: max(1, len(points) // 20_000)], [2, 98], axis=0)
    if result.after:
        centers = np.stack([T[:3, 3] for T in result.after.values()])
        extended = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
        # Distant cameras around an object would make it small.
        if np.linalg.norm(extended[1] - extended[0]) <= _MAX_EXTENT_RATIO * np.linalg.norm(
            high - low
        ):
            low, high = extended
    size = max(float(np.linalg.norm(high - low)), 1e-2)
    forward = np.array([0.0, 0.0, 1.0])
    forward -= result.up * (forward @ result.up)
    if np.linalg.norm(forward) < 0.1:
        forward = np.cross(result.up, [1.0, 0.0, 0.0])
    forward /= np.linalg.norm(forward)
    side = np.cross(forward, result.up)
    centre = (low + high) / 2
    position = centre + size * (0.6 * result.up - 0.6 * forward + 0.3 * side)
    server.scene.set_up_direction(result.up)
    server.initial_camera.look_at = centre
    server.initial_camera.position = position
    for client in server.get_clients().values():  # those that watched the run
        client.camera.up_direction = result.up
        client.camera.position = position
        client.camera.look_at = centre
    return size


def _point_size(points: NDArray[np.floating]) -> float:
    return max(1.3 * spacing_of(points.astype(float)), 1e-4)


def _nearest(pictures: tuple[Pictures, ...], index: int) -> Pictures | None:
    return min(pictures, key=lambda p: abs(p.index - index), default=None)


def decoded(data: bytes) -> UInt8:
    """Decode an image file to (H, W, 3) RGB."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return np.zeros((1, 1, 3), np.uint8)
    return image[..., ::-1].astype(np.uint8)


def wxyz(T: Float64) -> Float64:
    """Return the quaternion (4,) of a pose (4, 4), in viser's order w, x, y, z."""
    x, y, z, w = from_matrix(T[:3, :3])
    return np.array([w, x, y, z])


def _length(metres: float) -> str:
    return f"{1000 * metres:.1f} mm" if metres < 1 else f"{metres:.3f} m"


def color_bar(label: str, labels: Sequence[str]) -> str:
    """Return a colour bar with a title, and labels at its ends and in its middle, as HTML."""
    stops = ", ".join(f"rgb{tuple(c)}" for c in viridis(np.linspace(0, 1, 9)).tolist())
    ticks = "".join(f"<span>{text}</span>" for text in labels)
    return (
        f'<div style="padding:0 0.8em 0.5em;font-size:0.85em">{label}'
        f'<div style="height:12px;border-radius:3px;background:linear-gradient(90deg,{stops})">'
        f'</div><div style="display:flex;justify-content:space-between">{ticks}</div></div>'
    )


def _escape_markdown(text: str) -> str:
    """Text with the special characters of Markdown and HTML escaped."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|$~" else c for c in text)


def _images_html(picture: Pictures) -> str:
    """The images of a frame as HTML, embedded as data URIs."""
    cells = []
    for kind in picture.images:
        title, source = KINDS[kind], picture.uri(kind)
        style = "width:100%;border-radius:4px;image-rendering:pixelated;display:block"
        cells.append(
            f'<figure style="margin:0"><img alt="{title}" src="{source}" style="{style}">'
            f'<figcaption style="font-size:0.8em">{title}</figcaption></figure>'
        )
    grid = "display:grid;grid-template-columns:1fr 1fr;gap:6px;padding:0 0.6em 0.4em"
    return f'<div style="{grid}">{"".join(cells)}</div>{_fate_legend()}'


def _fate_legend() -> str:
    cells = (
        f'<span style="white-space:nowrap;margin-right:10px"><i style="display:inline-block;'
        f'width:10px;height:10px;background:rgb{color}"></i> {words}</span>'
        for color, words in FATES.values()
    )
    return f'<div style="font-size:0.8em;padding:0 1em 0.6em">{"".join(cells)}</div>'
