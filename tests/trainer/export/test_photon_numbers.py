"""Fixed patterns trained on photon numbers and exported: the bundle's table is the trained head's, and says what it takes."""

# ruff: noqa: E402  (what follows needs torch)
from pathlib import Path

import numpy as np
import pytest
from trainings import bars_task, short_fits  # noqa: F401 - a fixture

torch = pytest.importorskip("torch", reason="needs the train extra")
pytest.importorskip("onnx", reason="needs the train extra")

from pans.runtime.bundle.model import load_bundle
from pans.runtime.instrument.click_law import CountLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import evaluate_exactly, light_of
from pans.trainer.export.writer import export_trained
from pans.trainer.options import Options
from pans.trainer.train.loop import train


@pytest.mark.usefixtures("short_fits")
def test_trained_numbers_are_exported_as_they_were_trained(tmp_path: Path) -> None:
    task, profile = bars_task(), load_profile("dmd-qcmos")
    options = Options(3, photons=8.0, outcomes=4, estimator="local", epochs=6, hidden=16, batch=64, warm=0.5)
    trained = train(task, profile, options)
    assert isinstance(trained.law, CountLaw)
    assert trained.law.outcomes == 4
    exported = export_trained(tmp_path / "n.pans", trained, task, profile, name="n", provenance={})
    bundle, _ = load_bundle(tmp_path / "n.pans")
    assert (bundle.outcomes, exported.words_compared) == (4, 64)
    assert bundle.table is not None
    words = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    with torch.no_grad():
        scores = trained.head(torch.from_numpy((words / 3).astype(np.float32))).numpy()
    assert np.allclose(bundle.table, scores, atol=1e-4)
    light = light_of(bundle, profile, task.test.images)
    found = evaluate_exactly(bundle, light, task.test.labels)
    assert found.accuracy_mean > 1.5 / len(task.classes)
    mean = trained.click_mean.numpy() * 3  # of the training objects, which the test objects are like
    assert np.allclose(mean, light_of(bundle, profile, task.train.images).probability.mean(axis=0), atol=0.02)
