"""`pans train --encoder automaton`: from images to a bundle that runs, its answer, and what is refused."""

import json

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import main

SHORT = ["--encoder", "automaton", "--exposures", "4", "--states", "8", "--epochs", "2", "--batch", "64"]


@pytest.fixture
def images(tmp_path):
    task = bars_task()
    path = tmp_path / "bars.npz"
    parts = {"train_images": task.train.images, "train_labels": task.train.labels}
    np.savez(path, **parts, test_images=task.test.images, test_labels=task.test.labels)
    return str(path)


def test_trains_exports_and_reports(images, tmp_path, capsys):
    out = tmp_path / "bars.pans"
    assert main(["train", images, *SHORT, "--photons", "3", "-o", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
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
    assert main(["train", images, *more, "--photons", "2.5", "-o", str(tmp_path / "more.pans")]) == 0
    told = capsys.readouterr().err
    assert "shown" in told
    assert "grow" not in told
    options = load_bundle(tmp_path / "more.pans")[0].provenance["options"]
    assert (options["start"], options["exposures"], options["states"]) == (digest, 4, 8)
    assert (options["rate"], options["reroutes"]) == (0.05, 0)


def refusal(capsys, *words):
    assert main(["train", *words]) == 2
    return capsys.readouterr().err


def test_refusals(images, tmp_path, capsys):
    out = ["-o", str(tmp_path / "x.pans")]
    assert "one budget" in refusal(capsys, images, *SHORT, "--as-is", *out)
    assert "--features, --head: not of an automaton" in refusal(
        capsys, images, *SHORT, "--photons", "3", "--features", "4", "--head", "conv", *out
    )
    assert "--states belongs to an automaton" in refusal(capsys, images, "--features", "3", "--states", "4", *out)
    words = refusal(capsys, images, "--features", "3", "--exposure-price", "0.1", *out)
    assert "--exposure-price belongs to an automaton" in words
    for option, value in (("--soft", "1.1"), ("--decide", "-0.1"), ("--exposure-price", "11.0")):
        with pytest.raises(SystemExit):
            main(["train", images, *SHORT, "--photons", "3", f"{option}={value}", *out])
        words = capsys.readouterr().err
        assert option in words
        assert value in words
    teacher = ["--teacher", str(tmp_path / "x.npz")]
    assert "no soft targets are wanted" in refusal(capsys, images, *SHORT, "--photons", "3", *teacher, *out)
    start = ["--photons", "3", "--start", "fashion-adaptive"]
    assert "the automaton of --start has" in refusal(capsys, images, *SHORT, *start, *out)
    assert "--start belongs to an automaton" in refusal(capsys, images, "--features", "3", *start[2:], *out)
    assert "--channels belongs to an automaton" in refusal(capsys, images, "--features", "3", "--channels", "2", *out)
    words = refusal(capsys, images, *SHORT, "--photons", "3", "--channels", "2", *out)
    assert "2 channels per exposure, ideal has 1 (detector.channels)" in words
    assert "--features is missing" in refusal(capsys, images, "--as-is", *out)
    fiber = refusal(capsys, "fiber", *SHORT, "--photons", "3", *out)
    assert "the light is the scene's own" in fiber
    assert not list(tmp_path.glob("*.pans*"))
