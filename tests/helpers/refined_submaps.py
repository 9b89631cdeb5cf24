"""A refinement of simulated views in submaps."""

from __future__ import annotations

import numpy as np

from tofuse.engine.compute.spill import Scratch
from tofuse.engine.graph import build_graph, external_sensors
from tofuse.engine.stored_views.view_store import Spacing, ViewStore


def refined(part, views, poses, scratch=Scratch()):  # noqa: B008 - immutable
    store = ViewStore(Spacing(angle=0, distance=0), scratch=scratch)
    out = part.start(store)
    for view, T in zip(views, poses, strict=True):
        store.push(view, T)
    graph = build_graph(range(len(poses)), np.array(poses), [], [])
    return out.finish(graph, external_sensors.SensorPriors())
