"""Runs of fixed patterns that take photon numbers: replayed, exported, refitted, refused where nothing counts."""

import csv
from pathlib import Path

import numpy as np
import pytest
from bundles import made_bundle
from commands import json_of

from pans.app.main import main
from pans.bundle.backends import make_decider
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.record.reading import read_recording
from pans.record.reading.exposures import click_list
from pans.record.reading.sent_plan import recorded_plan

N_OBJECTS, TRIALS, D_F, LARGEST = 60, 3, 3, 3
PATTERNS = np.zeros((D_F, 16), np.int64)
PATTERNS[0, :8], PATTERNS[1, 8:], PATTERNS[2, 4:12] = 1, 1, 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of two classes, bright above and bright below; and a run with a table that knows nothing of them."""
    folder = tmp_path_factory.mktemp("photons")
    rng = np.random.default_rng(1)
    labels = np.arange(N_OBJECTS) % 2
    images = rng.integers(0, 120, (N_OBJECTS, 4, 4))
    images[labels == 0, :2] += 135
    images[labels == 1, 2:] += 135
    np.savez(folder / "halves.npz", images=images.astype(np.uint8), labels=labels, classes=np.array(["above", "below"]))
    shown = {
        "outcomes": LARGEST + 1,
        "pattern_levels": PATTERNS,
        "image_shape": (4, 4),
        "photons_per_level": 0.25,
        "classes": ["above", "below"],
    }
    table = np.random.default_rng(2).normal(size=(64, 2))
    write_bundle(made_bundle(D_F, 2, table=table, **shown), folder / "table.pans")
    main(["run", str(folder / "table.pans"), "--device", device(folder), *MANY, "--out", str(folder / "run")])
    return folder


MANY = ("--trials", str(TRIALS), "--decisions", str(N_OBJECTS * TRIALS), "-q")


def device(folder: Path, seed: int = 5) -> str:
    return f"sim:dmd-qcmos?scene={folder / 'halves.npz'}&seed={seed}&pace=fast"


def test_a_run_of_photon_numbers_replays_and_is_exported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "run" / "run.pansrec"
    recording = read_recording(path)
    assert recording.header["config"]["photon_number_max"] == LARGEST
    assert click_list(recording, recorded_plan(recording)).photons.max() == LARGEST
    for command in ("replay", "verify"):
        assert main([command, str(path)]) == 0
    capsys.readouterr()
    assert main(["export", "--format", "csv", "--out", str(folder / "csv"), str(path)]) == 0
    with (folder / "csv" / "clicks.csv").open() as file:
        rows = [int(row["photons"]) for row in csv.DictReader(file)]
    assert sum(rows) >= recording.decisions()["clicks"].sum() > 0
    assert main(["report", str(path), "--out", str(folder / "page.html")]) == 0


def test_a_refit_over_numbers_keeps_them(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = folder / "new.pans"
    told = json_of(capsys, "refit", folder / "table.pans", folder / "run" / "run.pansrec", "-o", new)
    assert (told["objects"], told["decisions"], told["changed"]) == (N_OBJECTS, N_OBJECTS * TRIALS, True)
    assert told["held_out"]["log_loss_gain"]["low"] > 0
    bundle, _ = load_bundle(new)
    assert (bundle.outcomes, len(bundle.table)) == (LARGEST + 1, 64)
    assert [make_decider(bundle).decide(np.array(word), 1).label for word in ([3, 0, 1], [0, 3, 1])] == [0, 1]


def test_a_detector_that_only_clicks_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--decisions", "20", "--record", str(folder / "never.pansrec"))
    found = json_of(capsys, "run", folder / "table.pans", "--device", "sim:dmd-spad?pace=fast", *words, code=2)
    assert "toy has 4 outcomes per exposure, dmd-spad tells 2 apart" in found["error"]["message"]
    more = ("--on-dark", "tables", "--device", device(folder))
    found = json_of(capsys, "run", folder / "table.pans", *more, *words, code=2)
    assert "takes photon numbers" in found["error"]["message"]
    assert not (folder / "never.pansrec").exists()
