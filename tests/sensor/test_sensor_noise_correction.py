"""The camera's noise model assigns a sigma to each pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import tofuse
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.adaptation import with_recording_defaults
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.noise.model import NOISE, NOISE_MODEL, AmplitudeLaw, NoiseModel, RangeLaw
from tofuse.engine.sensor.base import Noise

CAMERA = Pinhole(60, 50, 60.0, 60.0, 29.5, 24.5)
MINE = NoiseModel("mine", RangeLaw(0.004, 0.003), AmplitudeLaw(0.0, 1.5))


def frames(camera=CAMERA, *, amplitude=False, confidence=False):
    shape = (camera.height, camera.width)
    z = np.linspace(1, 2, shape[0] * shape[1], dtype=np.float32).reshape(shape)
    light = np.full(shape, 500, np.float32) if amplitude else None
    level = np.full(shape, 2, np.uint8) if confidence else None
    return [
        RangeFrame(k, k / 10, camera, z, amplitude_image=light, confidence_image=level)
        for k in range(2)
    ]


def recording(folder, *args, metadata=None, **kwargs):
    source = ArraySource(frames(*args, **kwargs), metadata=metadata or {})
    return Recording.of(source, str(folder), "native")


def model_of(config):
    (noise,) = (c for c in config.corrections if isinstance(c, Noise))
    return noise.model


def test_noise_model_assigns_sigma():
    (frame, _) = frames(amplitude=True)
    found = Noise(MINE).start().apply(frame)
    np.testing.assert_allclose(found.sigma_image, 1.5 / 500, rtol=1e-5)
    np.testing.assert_array_equal(found.depth, frame.depth)
    assert Noise().start().apply(frame) is frame


def test_stated_sigma_and_clouds_are_unchanged():
    (frame, _) = frames()
    own = replace(frame, sigma_image=np.full(frame.depth.shape, 0.02, np.float32))
    assert Noise(MINE).start().apply(own) is own
    cloud = CloudFrame.of(np.eye(3))
    assert Noise(MINE).start().apply(cloud) is cloud


def test_default_method_uses_noise_model_of_recording(tmp_path):
    stored = recording(tmp_path)
    stored.source.metadata[NOISE_MODEL] = MINE
    config = with_recording_defaults(from_method("default"), stored)
    assert model_of(config) == MINE
    # It is preserved by run.json.
    assert model_of(changed(config, {}, where="test")) == MINE
    result = tofuse.reconstruct(stored)
    assert result.config["corrections"][0]["model"]["range"] == {"a": 0.004, "b": 0.003}


def test_only_known_camera_families_have_noise_model(tmp_path):
    lidar = Pinhole(256, 192, 200.0, 200.0, 127.5, 95.5)
    known = recording(tmp_path, lidar, confidence=True)
    assert model_of(with_recording_defaults(from_method("default"), known)) == NOISE["iphone"]
    # Of that size, but with amplitude: not an iPhone.
    lit = recording(tmp_path, lidar, confidence=True, amplitude=True)
    assert model_of(with_recording_defaults(from_method("default"), lit)) is None
    assert model_of(with_recording_defaults(from_method("default"), recording(tmp_path))) is None
