"""A training that is terminated: exit code 130, its checkpoint, and the time of all its processes after `--resume`."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import Pans
from trainings import bars_task, kept_task, short_fits  # noqa: F401 - a fixture

from pans.runtime.bundle.model import load_bundle
from pans.trainer.train import checkpoint

FIXED = ["--features", "2", "--epochs", "2", "--batch", "64", "--hidden", "8"]
AUTOMATON = ["--encoder", "automaton", "--photons", "3", "--exposures", "3", "--states", "4", "--epochs", "1"]


@pytest.mark.usefixtures("short_fits")
@pytest.mark.parametrize(("module", "words"), [("train.loop", FIXED), ("adaptive.train", AUTOMATON)])
def test_a_terminated_training_says_so_and_goes_on(
    module: str, words: list[str], tmp_path: Path, pans: Pans, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_task(tmp_path / "bars.npz", bars_task())
    before, out = signal.getsignal(signal.SIGTERM), tmp_path / "bars.pans"
    command = ["train", str(tmp_path / "bars.npz"), *words, "--as-is", "-o", str(out), "--json"]

    def killed(*given: Any) -> None:
        checkpoint.write_checkpoint(*given)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(f"pans.trainer.{module}.write_checkpoint", killed)
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
