"""From tracked frames in one frame of reference to a reconstruction: the steps at the end of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.evaluation.sightings import Sightings, sightings
from tofuse.fusion.cloud import Cloud
from tofuse.fusion.model import Model, ModelBuilder
from tofuse.odometry.prediction import prediction_sigma, with_prediction
from tofuse.pipeline.checkpoint import Stages
from tofuse.pipeline.config import Config
from tofuse.pipeline.frame_log import FrameLog
from tofuse.pipeline.judge import Evidence, judge
from tofuse.pipeline.progress import Progress, Stopwatch
from tofuse.posegraph.build import Measured, build_graph
from tofuse.posegraph.graph import Optimisation, PoseGraph
from tofuse.posegraph.joining import Join
from tofuse.posegraph.loops import ClosedLoop, GivenLoop, Loops
from tofuse.posegraph.outside import Told, told_by, with_outside
from tofuse.posegraph.refinement import Refinement, Refiner
from tofuse.posegraph.trust import LEFT_OUT, pose_covariances, without_left_out
from tofuse.recordings.frames import RangeFrame
from tofuse.results.types import Component, Diagnostics, FrameRecord, Reason, Reconstruction

T = TypeVar("T")

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """What the verdict looks at: without sensors beside the camera, but for how they led."""

    sequential: Float64
    optimisation: Optimisation
    covariances: Float64


@dataclass(frozen=True, eq=False)
class Closed:
    """What there is once loops are closed."""

    loops: list[ClosedLoop]
    sequential: Float64
    optimisation: Optimisation
    covariances: Float64
    told: Told
    judged: Judged


@dataclass(frozen=True, eq=False)
class Refined:
    """What there is once all views are refined."""

    graph: PoseGraph
    refinement: Refinement


@dataclass(frozen=True, eq=False)
class Fused:
    """The model, and how it looked before poses moved; None where none did."""

    model: Model
    before: Cloud | None


@dataclass(frozen=True, eq=False)
class Kept:
    """What a run keeps of its frames for the end.

    Attributes
    ----------
    checks
        Images that are compared with each other at the final poses.
    depths
        Typical radial range of each posed frame, m, by index.
    """

    loops: Loops
    refiner: Refiner
    model: ModelBuilder
    checks: Sequence[RangeFrame]
    depths: dict[int, float]


class BackEnd:
    """Closes loops, optimises, refines, fuses and judges one connected part of a recording.

    Parameters
    ----------
    log
        What became of its frames.
    poses
        (4, 4) T_world_camera by index of the frames that have one, the identity first.
    joins
        Edges between components.
    """

    def __init__(
        self,
        config: Config,
        log: FrameLog,
        poses: dict[int, Float64],
        joins: Sequence[Join],
        given: Sequence[GivenLoop],
        kept: Kept,
        progress: Progress,
        watch: Stopwatch,
    ) -> None:
        self._config, self._log, self._poses, self._joins = config, log, poses, joins
        self._given, self._kept, self._progress, self._watch = given, kept, progress, watch
        self._posed = [e for e in log.posed if e.record.index in poses]

    def run(self, stages: Stages, components: tuple[Component, ...]) -> Reconstruction:
        """Make the reconstruction; `stages` keeps what there is after each step."""
        closed = self._staged(stages, "loops", self._close)
        refined = self._staged(stages, "refinement", lambda: self._refine(closed))
        fused = self._staged(stages, "fusion", lambda: self._fuse(closed, refined))
        return self._judge(closed, refined, fused, components)

    def _staged(self, stages: Stages, name: str, work: Callable[[], T]) -> T:
        """Do the work of a stage, unless a stopped job has done it; its time counts either way."""
        kept = stages.load(name)
        if kept is not None:
            found: T = kept[0]
            self._watch.seconds.update(kept[1])
            return found
        found = work()
        with self._watch.timing("keeping"):
            stages.save(name, (found, dict(self._watch.seconds)))
        return found

    def _close(self) -> Closed:
        self._progress.stage("closing loops")
        with self._watch.timing("loops"):
            loops = self._kept.loops.finish(self._poses)
            graph = self.graph(loops)
        sequential = led = graph.poses
        sensed = self._log.sensed(graph.ids.tolist())
        told = told_by(self._config.outside, sensed, self.graph(()))
        graph = with_outside(graph, told)
        optimisation = Optimisation(graph, (), True)
        if graph.loop.any() or told:
            self._progress.stage("optimising")
            with self._watch.timing("optimisation"):
                optimisation = self._config.optimiser.optimise(graph)
                if told and graph.loop.any():  # what loops are to be compared with
                    alone = with_outside(self.graph(()), told)
                    led = self._config.optimiser.optimise(alone).graph.poses
            loops = _decided(loops, optimisation, self._extra)
            optimisation = without_left_out(optimisation)
        graph = optimisation.graph
        covariances = pose_covariances(graph)
        judged = Judged(led, optimisation, covariances)
        if told:
            # The verdict stays with what was seen: no file beside the images makes it better.
            seen = self.graph(loops).with_poses(graph.poses)
            judged = Judged(led, replace(optimisation, graph=seen), pose_covariances(seen))
        return Closed(loops, sequential, optimisation, covariances, told, judged)

    def _refine(self, closed: Closed) -> Refined:
        graph = closed.optimisation.graph
        self._progress.stage("refining")
        with self._watch.timing("refinement"):
            refinement = self._kept.refiner.finish(graph.ids.tolist(), graph.poses, closed.told)
            if refinement.kept:
                graph = with_outside(self.graph(closed.loops, refinement), closed.told)
        return Refined(graph, refinement)

    def _fuse(self, closed: Closed, refined: Refined) -> Fused:
        graph, refinement, model = refined.graph, refined.refinement, self._kept.model
        moved = bool(graph.loop.any()) or refinement.kept or bool(closed.told)
        self._progress.stage("fusing", model.views)
        with self._watch.timing("fusion"):
            ids = graph.ids.tolist()
            fused = model.fuse(
                dict(zip(ids, graph.poses, strict=True)),
                self._progress.advance,
                refinement.errors,
            )
            started = dict(zip(ids, closed.sequential, strict=True))
            return Fused(fused, model.sketch(started) if moved else None)

    def _judge(
        self,
        closed: Closed,
        refined: Refined,
        fused: Fused,
        components: tuple[Component, ...],
    ) -> Reconstruction:
        optimisation, graph, model = closed.optimisation, refined.graph, fused.model
        self._progress.stage("checking")
        records = self._records(closed.covariances)
        loops = tuple(c.record for c in closed.loops)
        # Only who looks at surfaces states errors that can be relied on; ICP's are too small.
        knows_errors = any(e.step is not None and e.step.reason != "" for e in ()) or (
            "range" in self._config.odometry.takes and self._config.knows_errors
        )
        registrations = tuple(
            e.step.registration if e.step is not None and e.record.index in self._poses else None
            for e in self._log.entries
        )
        with self._watch.timing("checking"):
            evidence = Evidence(
                records,
                registrations,
                loops,
                closed.judged.sequential,
                closed.judged.optimisation,
                self._sightings(graph),
                closed.judged.covariances if knows_errors else None,
                refined.refinement,
                frozenset((g.i, g.j) for g in self._given),
                tuple(d for f, d in self._kept.depths.items() if d > 0 and f in self._poses),
                self._log.ambiguity_m,
                tuple(self._log.repeated),
                tuple(self._breaks()),
                closed.told.records,
            )
            verdict, reasons = judge(evidence)
        reasons = (*reasons, *self._about_surface(model))
        return Reconstruction(
            trajectory=self._scatter(graph.poses),
            timestamps=np.array([e.record.timestamp for e in self._log.entries]),
            graph=graph,
            cloud=model.cloud,
            mesh=model.mesh,
            diagnostics=Diagnostics(
                verdict,
                reasons,
                records,
                loops,
                self._scatter(closed.sequential),
                optimisation.objective,
                {},
                {},
                fused.before,
                refined.refinement,
                optimisation.parts,
                closed.told.records,
            ),
            config=self._config.to_dict(),
            recording={"path": None, "format": "frames", "frames": len(self._log.entries)},
            seed=0,
            threads=1,
            components=components,
        )
