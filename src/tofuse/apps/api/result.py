"""`tofuse.reconstruct`, `merge`, `load` and `Mapper`, and the result that they return."""

from __future__ import annotations

import html
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from tofuse.apps.certainty import Length, LengthErrors
from tofuse.apps.cli import progress_in_python
from tofuse.apps.jobs import (
    Evaluation,
    evaluate,
    locating,
    merging,
    quick_findings,
    with_findings,
    write_report_files,
)
from tofuse.apps.results import folders, integrity, load_result, reopening, run_json, write_result
from tofuse.engine import quantities
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import Frame, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping import Config, adaptation, configured, reconstructing
from tofuse.engine.mapping import Mapper as OnlineMapper
from tofuse.engine.parts import name_of
from tofuse.engine.progress import Progress, Silent, receiver
from tofuse.engine.results import Reconstruction, accuracy_card
from tofuse.formats.rigs import check_one_camera

if TYPE_CHECKING:
    from tofuse.apps.viewer import ReportServer


_THUMBNAIL = (420, 262)  # pixels


@dataclass(frozen=True, eq=False, repr=False)
class Result(Reconstruction):
    """A reconstruction: see `Reconstruction` for its fields.

    Attributes
    ----------
    source
        The recording; None for a result that was loaded.
    fitted
        The configuration after its parts were fitted to the recording, if known.
    folder
        The folder that it was loaded from.
    """

    source: Recording | None = None
    fitted: Config | None = None
    folder: Path | None = None

    @classmethod
    def of(
        cls,
        reconstruction: Reconstruction,
        source: Recording | None = None,
        fitted: Config | None = None,
    ) -> Self:
        """Make a result of a reconstruction, for example that of `Mapper.finish`.

        Parameters
        ----------
        reconstruction
            The reconstruction.
        source
            The recording, if known.
        fitted
            The configuration after its parts were fitted to the recording, if known.
        """
        values = {f.name: getattr(reconstruction, f.name) for f in fields(Reconstruction)}
        return cls(**values, source=source, fitted=fitted)

    @property
    def accuracy(self) -> str:
        """The accuracy in one line: bound, coverage, least certain frame, advice."""
        return accuracy_card.SEPARATOR.join(accuracy_card.card(self))

    @signals_as_themselves()
    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the files of ``tofuse run``, and return the folder.

        The report of a loaded result contains no images of its recording.

        Parameters
        ----------
        folder
            A new or empty folder, or one with an earlier result.
        overwrite
            Whether to replace an earlier result.

        Raises
        ------
        InputError
            If the trajectory was replaced by what is not a trajectory.
        OutputError
            If the folder contains anything but a result, or a result and `overwrite` is not set.
        """
        se3.check_poses(self.trajectory, where="trajectory", count=len(self.timestamps))
        # BLAS results depend on its number of threads.
        with folders.OutputFolder(folder, overwrite=overwrite) as out, threadpool_limits(1):
            write_result(self, out, self._write_report)
        return Path(folder)

    def _write_report(self, result: Reconstruction, folder: Path) -> None:
        from tofuse.apps.report import ReportExtras, write_report

        if self.source is not None:
            config = self.fitted or adaptation.adapted(
                configured(self.config, reconstructing.view_kind(self.source)), self.source
            )
            write_report_files(self.source, config, result, folder)
            return
        facts = result.recording
        opened = (facts.get("opening") or {}).get("paths") or [facts["path"] or facts["format"]]
        title = ", ".join(Path(str(path)).name for path in opened)
        write_report(result, folder / "report.html", ReportExtras(title))

    def evaluate(
        self,
        reference: str | Path | Recording | ArrayLike | None = None,
        *,
        reference_error_m: float | None = None,
    ) -> Evaluation:
        """Compare the trajectory with a reference.

        Parameters
        ----------
        reference
            A file, a recording with reference poses, or (N, 4, 4) T_world_camera of the same
            frames, NaN where there is none. None: the reference poses of the result's recording.
        reference_error_m
            Rms error of the reference itself, m.

        Raises
        ------
        InputError
            If there is no reference, or it does not match the frames.
        """
        poses = reference
        if poses is None:
            poses = None if self.source is None else self.source.reference
        if poses is None:
            raise InputError(
                "has no reference poses",
                where="the recording" if self.source else "the result",
                remedy="pass a reference",
            )
        return evaluate(
            self,
            poses
            if isinstance(poses, str | Path | Recording)
            else se3.check_poses(poses, where="reference"),
            recording=self.source,
            reference_error_m=reference_error_m,
            config=self.config,
        )

    @signals_as_themselves()
    def locate(self, frame: Frame) -> locating.LocatedFrame:
        """Find where an image was taken: its pose in this map, as ``tofuse locate`` does.

        The first call makes the index of the map, from the images of its recording.

        Parameters
        ----------
        frame
            A frame of `tofuse.open` or `tofuse.from_arrays`.

        Raises
        ------
        InputError
            If the frame is a cloud, or the recording of a loaded result is missing or has changed.
        """
        with threadpool_limits(1):
            return self._map.locate_frame(frame)

    @cached_property
    def _map(self) -> locating.ResultMap:
        if self.source is None or self.fitted is None:
            if self.folder is None:
                raise InputError(
                    "has no recording",
                    where="the result",
                    remedy="use one of tofuse.reconstruct, or load the result of a recording",
                )
            return locating.ResultMap.read(self.folder, None, Silent())
        return locating.ResultMap.of_result(self.source, self.fitted, self)

    @signals_as_themselves()
    def distance(self, point_a: ArrayLike, point_b: ArrayLike) -> Length:
        """Return the distance of two points of the model, with its 95 % interval and causes.

        As the report measures: points that the same views saw share the errors of their poses.

        Parameters
        ----------
        point_a, point_b
            (3,) each, in the world.

        Raises
        ------
        InputError
            If they are not two different points; or if the result has no surface of a single
            camera, or no covariances of poses.
        """
        if self._length_errors is None:
            raise InputError(
                "states no errors of lengths",
                where="the result",
                remedy="use a result with a surface of a single camera, and covariances of poses",
            )
        return self._length_errors.between(point_a, point_b)

    @cached_property
    def _length_errors(self) -> LengthErrors | None:
        frame = None
        if self.source is not None:
            frame = self.source.first_readable()
        elif self.folder is not None:  # without its recording, the field of view is a usual one
            with suppress(InputError), run_json.opened(self.folder) as run:
                part = next(reopening.stored_recordings(self.folder, run))
                frame = reopening.reopen(part, self.folder).first_readable()
        return LengthErrors.of(self, frame)

    def view(self, *, port: int | None = None, open_browser: bool = True) -> ReportServer:
        """Show the report in the browser, as ``tofuse view`` does, and return the server.

        The page is served by threads of this process, until the server is stopped or the process
        ends; in a ``with`` statement, until its end.

        Parameters
        ----------
        port
            Port of the server; None: 8080, or the next free one.
        open_browser
            Whether to open the page in the browser.
        """
        from tofuse.apps.viewer import FrameImages, ReportServer, report_pages

        images = None if self.source is None else FrameImages([(0, self.source)])
        with tempfile.TemporaryDirectory(prefix="tofuse-") as temporary:
            folder = self.save(Path(temporary) / "result")
            pages = report_pages(folder)
            if images is None:
                with suppress(InputError):  # the recording of a loaded result is gone
                    images = FrameImages.of(folder)
        server = ReportServer(pages, images, port)
        if open_browser:
            webbrowser.open(server.address)
        return server

    def _repr_html_(self) -> str:
        from tofuse.apps.report import scene, thumbnails

        rows = {f.index: k for k, f in enumerate(self.diagnostics.frames)}
        R_display_world = self.T_up_world[:3, :3] * [[1.0], [-1.0], [-1.0]]
        drawn = scene.make_scene(self, rows).view_rotation(R_display_world)
        accuracy = html.escape(self.accuracy)
        verdict = html.escape(self.diagnostics.verdict.capitalize())
        picture = ""
        if len(drawn.points):
            image = scene.render(drawn, _THUMBNAIL, yaw=scene.opening_yaw(drawn))
            source = thumbnails.data_uri(image)
            picture = f'<img src="{source}" alt="The model" style="border-radius:8px"><br>'
        return f"<div>{picture}<b>{verdict}</b>: {accuracy}</div>"


class Mapper(OnlineMapper):
    """Turns frames into a trajectory and a model, online.

    >>> mapper = Mapper("default")
    >>> for frame in frames:
    ...     T_world_camera = mapper.push(frame)   # None where lost
    ...     mapper.last.status, mapper.last.covariance
    >>> mapper.finish().save("result")

    Parameters
    ----------
    config
        A configuration, or the name of one; or options, as for `reconstruct`.
    seed
        The result is reproducible for each seed.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    loops
        Given loops, in frame indices: pairs (i, j), or (i, j, T_i_j) with the measured motion.
    progress
        Receives frames and stages.
    tracker
        Replaces that of the configuration's odometry.
    """

    def finish(self) -> Result:
        """Join components, close loops, optimise, refine, fuse and judge.

        Raises
        ------
        InputError
            If no frame has a pose.
        """
        return Result.of(super().finish())


@signals_as_themselves()
def reconstruct(
    recording: Recording,
    config: Config | str | Mapping[str, Any] = "default",
    *,
    seed: int = 0,
    threads: int | None = None,
    loops: Sequence[PriorLoop | Sequence[Any]] = (),
    prior: adaptation.Prior = "auto",
    progress: Progress | bool | None = None,
) -> Result:
    """Reconstruct a recording: trajectory, pose graph, fused cloud and surface, diagnostics.

    Frames that can't be read are skipped and counted. As at the start of `tofuse run`, a quick
    inspection of the recording precedes: its severe findings rule out the verdict "good".

    Parameters
    ----------
    recording
        A recording of `tofuse.open` or `tofuse.from_arrays`.
    config
        The name of a configuration ("default", "thesis"); or options that differ from the default,
        as in a TOML file of ``--config``: ``{"fusion": {"voxel_m": 0.01}}``; or a configuration.
    seed
        Random seed.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    loops
        Known loop closures, in frame indices: pairs (i, j), or (i, j, T_i_j) with the measured
        motion.
    prior
        Measurements of other sensors to use, as ``--prior`` of `tofuse run`: "auto" uses gravity,
        and a phone's own poses, "none" the images alone, "device" the recorded odometry too.
    progress
        True: progress bars on the terminal and in notebooks with ipywidgets, else a line a stage.

    Raises
    ------
    InputError
        If `recording` is not a recording or an option does not exist; if no frame can be read, or
        none has enough valid points for a pose; or if a filter can't estimate its parameters from
        the recording.
    """
    if not isinstance(recording, Recording):
        raise InputError(
            f"is {quantities.one(type(recording).__name__)}, not a recording",
            where="recording",
            remedy="pass tofuse.open(path), or tofuse.from_arrays(depth, K)",
        )
    check_one_camera(recording)
    with _with_terminal(progress) as display:
        chosen = configured(config, reconstructing.view_kind(recording))
        # No sensor measures the motion relative to a moving object.
        filters = {name_of(part) for part in chosen.filters}
        if not filters & {"background", "foreground"}:
            recording, chosen = adaptation.with_prior(recording, chosen, prior)
        fitted = adaptation.adapted(chosen, recording, threads, display)
        turning = "foreground" in filters
        findings = quick_findings(recording, fitted, turning=turning)
        reconstruction = reconstructing.reconstruct(
            recording, fitted, seed=seed, threads=threads, loops=loops, progress=display
        )
    return Result.of(with_findings(reconstruction, findings, turning=turning), recording, fitted)


@signals_as_themselves()
def merge(
    results: Sequence[str | Path],
    *,
    tolerance_m: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> Result:
    """Merge the results of several runs into one map, in the world frame of the first.

    Parameters
    ----------
    results
        Output folders of ``tofuse run`` or ``tofuse merge``; at least two sessions. Their
        recordings must still be at their paths.
    tolerance_m
        Accuracy required of a good map, m; by default that of the first result.
    seed, threads, progress
        As for `reconstruct`.

    Returns
    -------
    A result like that of a run, with `sessions` and `session_pairs`. Sessions that can't be joined
    to the first one are components with their own models.

    Raises
    ------
    InputError
        If a folder is not a result, or its recording is missing or has changed.
    """
    with _with_terminal(progress) as display:
        merged = merging.merge(
            results, tolerance_m=tolerance_m, seed=seed, threads=threads, progress=display
        )
    return Result.of(merged)


def _with_terminal(progress: Progress | bool | None) -> AbstractContextManager[Progress]:
    return progress_in_python() if progress is True else nullcontext(receiver(progress))


@signals_as_themselves()
def load(folder: str | Path, *, edited: bool = False) -> Result:
    """Read a result of ``tofuse run`` or `Result.save` from its folder.

    Parameters
    ----------
    folder
        The folder.
    edited
        Whether to read it although its files were changed by hand.

    Raises
    ------
    InputError
        If it is not an output folder, or its files are damaged, edited or of different runs.
    """
    with integrity.accepting_edits() if edited else nullcontext():
        return replace(Result.of(load_result(folder)), folder=Path(folder))
