"""Exports: every click and decision of a real run, again from CSV and from Photon-HDF5."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from bundles import made_bundle
from commands import fixed_run, json_of
from heads import onnx_chain, random_layers

from pans.runtime.bundle.model import write_bundle
from pans.runtime.cli import main
from pans.runtime.instrument.profile import load_profile
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan


@pytest.fixture(scope="module", params=["oled-qcmos", "wdm-snspd"])
def run_of(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one detector after another, and of all at once with dark slots."""
    folder = tmp_path_factory.mktemp("run")
    words = [*fixed_run(200)]
    if request.param == "wdm-snspd":
        make_parallel(folder / "small.pans")
        words = ["run", str(folder / "small.pans"), "--device", "sim:wdm-snspd?pace=fast&scene=fashion200"]
        words += ["--decisions", "150", "--shots", "4"]
    assert main([*words, "--out", str(folder)]) in (0, 1)
    return folder / "run.pansrec"


def make_parallel(path: Path) -> None:
    profile, rng = load_profile("wdm-snspd"), np.random.default_rng(0)
    top, levels = profile.projector.peak_photoelectrons_hz * profile.exposure.max_us * 1e-6, profile.projector.levels
    patterns = rng.integers(0, levels, (5, 784)) * (rng.random((5, 784)) < 0.05)
    patterns[0, 0] = levels - 1
    shown = {"levels": levels, "pattern_levels": patterns, "photons_per_level": top / (levels - 1)}
    head = onnx_chain(random_layers([5, 8, 10]))
    made = made_bundle(classes=tuple("0123456789"), image_shape=(28, 28), head_onnx=head, **shown)
    write_bundle(made, path)


def test_csv_holds_every_click_and_decision(run_of: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = json_of(capsys, "export", run_of, "--format", "csv", "-o", tmp_path / "csv")
    recording = read_recording(run_of)
    decisions = recording.decisions()
    with open(tmp_path / "csv" / "decisions.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found["decisions"] == recording.n_decisions
    classes = recording.bundle().classes
    for row, wanted in zip(rows, decisions):
        assert (int(row["tick"]), int(row["object"]), int(row["clicks"])) == tuple(wanted[["tick", "object", "clicks"]])
        assert row["class"] == classes[wanted["label"]]
        assert np.float32(row["probability"]) == wanted["probability"]
    with open(tmp_path / "csv" / "clicks.csv", newline="") as file:
        clicks = list(csv.DictReader(file))
    assert len(clicks) == found["clicks"]
    # the clicks behind each decision, counted from the exported file alone
    lit = [row for row in clicks if row["dark_slot"] == "0"]
    per_object = np.bincount([int(row["object"]) for row in lit], minlength=len(rows))
    assert per_object.tolist() == decisions["clicks"].tolist()
    assert found["simulated"] is True
    about = json.loads((tmp_path / "csv" / "about.json").read_text())
    assert about["exposures"] == found["exposures"]


def test_the_clicks_are_in_order_and_within_the_plan(run_of: Path) -> None:
    recording = read_recording(run_of)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    assert (np.diff(clicks.start_tick) >= 0).all()
    assert clicks.exposures == recording.n_decisions * plan.slots_per_cycle * plan.cycles_per_object
    assert clicks.channel.max() < (plan.n_patterns if plan.mode == "parallel" else 1)
    slot = clicks.exposure % plan.slots_per_cycle
    assert (plan.slot_pattern[slot] == clicks.pattern).all()
