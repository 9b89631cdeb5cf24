"""What is stored of the frames of a long recording."""

from __future__ import annotations

from dataclasses import replace

from made_rooms import at, seen
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.observations import Observations
from tofuse.engine.mapping.preparation import FilteredFrame
from tofuse.engine.tracking.base import Step


def add(observations, frame, T):
    observations.add_to_model(FilteredFrame(frame, frame, frame, ()), Step("tracked", "", T))


def test_images_of_a_camera_that_stays_are_thinned_in_the_model() -> None:
    observations = Observations(from_method("default"), 0, ())
    frame = seen(at(0, 0, 0), 0)
    for index in range(100):
        add(observations, replace(frame, index=index), at(0, 0, 0))
    observations.finish()
    # The first 32, every second one of the next 64, and every fourth one of the other 4.
    assert observations.model.views == 65


def test_images_of_a_camera_that_moves_on_are_all_in_the_model() -> None:
    observations = Observations(from_method("default"), 0, ())
    frame = seen(at(0, 0, 0), 0)
    for index in range(100):
        add(observations, replace(frame, index=index), at(0, 0, 0.06 * index))
    observations.finish()
    assert observations.model.views == 100
