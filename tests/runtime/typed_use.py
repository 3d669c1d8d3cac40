"""How a notebook uses `pans`, with the types that it gets: mypy checks this file as `pans.typed_use` (.typing); nothing runs it."""

from pathlib import Path
from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

import pans


def uses(images: NDArray[np.uint8], names: list[str]) -> None:
    bundle, profile = pans.load_bundle("fashion10"), pans.load_profile("ideal")
    assert_type(bundle, pans.Bundle)
    assert_type(profile, pans.Profile)
    assert_type(pans.decide(bundle, [1, 2]).labels, NDArray[np.uint16])
    done = pans.run(bundle, "sim:ideal", profile=profile, decisions=10, out="run")
    assert_type(done, pans.Outcome)
    assert_type(done.recording, Path | None)
    recording = pans.load_recording("run/run.pansrec")
    assert_type(recording, pans.Recording)
    assert_type(pans.replay(recording, recording.bundle()), pans.Replayed)
    measured = pans.evaluate(bundle, objects=10)
    assert_type(measured, pans.Measured | pans.MeasuredPictures | pans.MeasuredWalks)
    results = pans.train(images, names, photons=8.0, progress=False)
    assert_type(results, pans.SensorResults)
    assert_type(results.camera_at_equal_photons, pans.CameraResults | None)
    sensor = pans.PansClassifier(profile, photons=8.0, random_state=0).fit(images, names)
    assert_type(sensor, pans.PansClassifier)
    assert_type(sensor.predict_proba(images), NDArray[np.float64])
    assert_type(sensor.predict(images), NDArray[Any])
    assert_type(sensor.expected_score(images, names), float)
    pans.run(sensor.bundle_, "sim:ideal")
    pans.run(sensor.bundle_)  # type: ignore[call-arg]
    pans.train(images, names, photons="many")  # type: ignore[arg-type]
