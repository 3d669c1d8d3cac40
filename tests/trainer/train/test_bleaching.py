"""Training through samples that bleach: the encoder's light is that of the evaluation, and what makes no sense is refused."""

# ruff: noqa: E402  (what follows needs torch)
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from bundles import made_bundle
from trainings import bars_task

from pans.runtime.errors import UsageError
from pans.runtime.imaging import Bleaching
from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.evaluate.dose import training_readings
from pans.trainer.evaluate.held_out import Conditions, HeldOut, as_trained, measure, trained_bleaching
from pans.trainer.export.writer import export_trained
from pans.trainer.model.encoders import ActiveIllumination, new_encoder
from pans.trainer.options import Options, check_options, check_order
from pans.trainer.tasks.registry import Objects
from pans.trainer.train.loop import train

IDEAL = load_profile("ideal")
RNG = np.random.default_rng(4)
IMAGES = RNG.integers(0, 256, (9, 2, 3), dtype=np.uint8)
OPTIONS = Options(features=3, alpha=0.0, bleach="0.5:mixed")


@pytest.mark.parametrize("bleach", ["0.5", "0.5:mixed"])
def test_the_encoder_is_trained_on_the_light_that_is_judged(bleach: str) -> None:
    encoder = new_encoder(6, IDEAL, replace(OPTIONS, bleach=bleach), torch.Generator().manual_seed(1))
    assert isinstance(encoder, ActiveIllumination)
    levels = RNG.integers(1, 16, (3, 6))
    with torch.no_grad():
        encoder.weight.copy_(torch.from_numpy(np.sqrt(levels * 0.01)))
    facts = {"levels": 16, "pattern_levels": levels, "photons_per_level": 0.01, "table": np.zeros((8, 2))}
    told = {"options": {"bleach": bleach}}
    bundle = made_bundle(3, 2, image_shape=(2, 3), provenance=told, **facts)
    law = trained_bleaching(bundle)
    assert law == Bleaching(0.5, bleach.endswith("mixed"))
    assert as_trained(bundle).bleaching == law
    wanted = light_of(bundle, IDEAL, IMAGES, bleaching=law)
    transmission = torch.from_numpy(IMAGES.reshape(9, 6) / 255).float()
    with torch.no_grad():
        found = encoder(transmission).numpy()
        assert float(encoder.illumination()) == pytest.approx(bundle.illumination(), rel=1e-6)
    np.testing.assert_allclose(found, wanted.photoelectrons, rtol=1e-5)
    assert (wanted.photoelectrons[:, 2] < 0.8 * light_of(bundle, IDEAL, IMAGES).photoelectrons[:, 2]).all()
    readings = training_readings(bundle, IDEAL, Objects(IMAGES, np.zeros(9, np.int64)))
    np.testing.assert_array_equal(readings[:, :, 1], wanted.probability)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"bleach": "0"}, "bleaching dose is 0"),
        ({"encoder": "coherent"}, "--bleach is for patterns that are sent once each"),
        ({"optics": "shift=1"}, "--bleach is for patterns that are sent once each"),
        ({"shots": 2}, "--bleach is for patterns that are sent once each"),
    ],
)
def test_what_cannot_be_trained_through_bleaching_is_refused(changed: dict[str, object], text: str) -> None:
    check_options(OPTIONS, IDEAL)
    with pytest.raises(UsageError, match=text):
        check_options(replace(OPTIONS, **changed), IDEAL)  # type: ignore[arg-type]


def test_bleaching_and_orders_need_patterns_one_after_another() -> None:
    with pytest.raises(UsageError, match="shows all patterns at once"):
        check_options(OPTIONS, load_profile("wdm-snspd"))
    with pytest.raises(UsageError, match="have an order already"):
        check_order("dose", OPTIONS)
    with pytest.raises(UsageError, match="have an order already"):
        check_order("information", Options(features=3, head="conv"))
    check_order("information", Options(features=3))


@pytest.mark.slow
def test_training_through_bleaching_pays_where_samples_bleach(tmp_path: Path) -> None:
    task, law = bars_task(3000), Bleaching(0.3)
    options = Options(features=5, photons=6.0, epochs=12, hidden=32, batch=128)
    found = []
    for bleach in (None, law.spelled()):
        trained = train(task, IDEAL, replace(options, bleach=bleach))
        path = tmp_path / f"{bleach}.pans"
        bundle = export_trained(path, trained, task, IDEAL, name="toy", provenance={}).bundle
        measured = measure(bundle, HeldOut(task, task.test, IDEAL), conditions=Conditions(bleaching=law))
        found.append((measured.accuracy_mean, measured.accuracy_se_objects))  # type: ignore[union-attr]
    (plain, error), (through, other) = found
    assert through - plain > 2 * math.hypot(error, other)
