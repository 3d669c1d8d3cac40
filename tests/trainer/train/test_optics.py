"""Training of fixed patterns through optics: the full level goes where the patterns need it."""

# ruff: noqa: E402  (what follows needs torch)
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.instrument.profile import load_profile
from pans.trainer.model.encoders import ActiveIllumination
from pans.trainer.options import Options
from pans.trainer.train.data import TrainingData
from pans.trainer.train.loop import Run


def test_the_full_level_rises_from_the_least_of_the_profile_where_patterns_need_it():
    ideal = load_profile("ideal")
    options = Options(
        features=4, photons=12.0, epochs=12, hidden=16, batch=64, front_rate=3e-2, optics="psf=0.5:black=0.002"
    )
    run = Run(TrainingData(bars_task(500), ideal, options), ideal, options, restart=0)
    encoder = run.encoder
    assert isinstance(encoder, ActiveIllumination)
    least, _ = encoder.top_limits
    assert float(encoder.top().detach()) == pytest.approx(least)
    reports = [run.one_epoch() for _ in range(8)]
    assert float(encoder.top().detach()) > 1.5 * least
    assert float(encoder.patterns().detach().max()) > 1.5 * least
    assert reports[-1].loss < reports[0].loss
