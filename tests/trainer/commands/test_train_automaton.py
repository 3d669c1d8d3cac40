"""`pans train --encoder automaton`: from images to a bundle that runs, what is refused; a training that is terminated, and goes on."""

import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import Pans
from trainings import (
    bars_task,
    kept_task,
    short_fits,  # noqa: F401 - a fixture
)

from pans.bundle.sensor.bundle import load_bundle
from pans_trainer.train.gradient import checkpoint

SHORT = ["--encoder", "automaton", "--exposures", "4", "--states", "8", "--epochs", "2", "--batch", "64"]


@pytest.fixture
def images(tmp_path):
    return str(kept_task(tmp_path / "bars.npz", bars_task()))


def test_trains_exports_and_reports(images, tmp_path, pans):
    out = tmp_path / "bars.pans"
    answer = pans("train", images, *SHORT, "--photons", "3", "-o", out)
    bundle, digest = load_bundle(out)
    assert answer["sha256"] == digest
    assert answer["simulated"] is True
    assert answer["objects"] == 400
    assert answer["first_200"]["objects"] == 200
    assert answer["accuracy_mean"] == bundle.expected["accuracy"] > 0.4
    assert answer["photons_mean"] < 3.3
    assert answer["budget_off"] == pytest.approx(answer["photons_mean"] / 3 - 1)
    assert bundle.provenance["options"]["photons"] == 3.0
    assert not list(tmp_path.glob("*.checkpoint"))
    for key in ("clicks_mean", "illumination", "exposures_mean", "expected_calibration_error"):
        assert answer[key] == pytest.approx(answer["first_200"][key], rel=0.5, abs=0.2)
    more = ["--encoder", "automaton", "--start", str(out), "--rate", "0.05", "--reroutes", "0", "--epochs", "1"]
    told = pans.refuses("train", images, *more, "--photons", "2.5", "-o", tmp_path / "more.pans", code=0)
    assert "shown" in told
    assert "grow" not in told
    options = load_bundle(tmp_path / "more.pans")[0].provenance["options"]
    assert (options["start"], options["exposures"], options["states"]) == (digest, 4, 8)
    assert (options["rate"], options["reroutes"]) == (0.05, 0)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([*SHORT, "--as-is"], "a budget of light"),
        ([*SHORT, "--photons", "3", "--features", "4", "--head", "conv"], "--features, --head: not of an automaton"),
        (["--features", "3", "--states", "4"], "--states belongs to an automaton"),
        (["--features", "3", "--start", "fashion-adaptive"], "--start belongs to an automaton"),
        ([*SHORT, "--photons", "3", "--teacher", "x.npz"], "no soft targets are wanted"),
        ([*SHORT, "--photons", "3", "--start", "fashion-adaptive"], "the automaton of --start has"),
        (["--as-is"], "--features is missing"),
    ],
)
def test_what_cannot_be_meant_is_refused(words, told, images, tmp_path, pans):
    assert told in pans.refuses("train", images, *words, "-o", tmp_path / "x.pans")
    assert not list(tmp_path.glob("*.pans*"))


FIXED = ["--features", "2", "--epochs", "2", "--batch", "64", "--hidden", "8"]
AUTOMATON = ["--encoder", "automaton", "--photons", "3", "--exposures", "3", "--states", "4", "--epochs", "1"]


@pytest.mark.usefixtures("short_fits")
@pytest.mark.parametrize(("module", "words"), [("train.gradient.loop", FIXED), ("train.automaton.train", AUTOMATON)])
def test_a_terminated_training_says_so_and_goes_on(
    module: str, words: list[str], tmp_path: Path, pans: Pans, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_task(tmp_path / "bars.npz", bars_task())
    before, out = signal.getsignal(signal.SIGTERM), tmp_path / "bars.pans"
    command = ["train", str(tmp_path / "bars.npz"), *words, "--as-is", "-o", str(out), "--json"]

    def killed(*given: Any) -> None:
        checkpoint.write_checkpoint(*given)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(f"pans_trainer.{module}.write_checkpoint", killed)
    assert pans(*command, code=130)["error"]["exit"] == 130
    assert signal.getsignal(signal.SIGTERM) is before
    monkeypatch.undo()

    state = tmp_path / "bars.pans.checkpoint"
    saved = torch.load(state, weights_only=True)
    assert 0 < saved["seconds"] < 600
    torch.save(saved | {"seconds": 5000.0}, state)  # as of processes that took long
    answer = pans(*command, "--resume")
    assert 5000 < answer["seconds"] < 5600
    assert load_bundle(out)[0].provenance["training_seconds"] >= 5000
    assert not state.exists()
