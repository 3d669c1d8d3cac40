"""`pans refit` on recordings of the simulated instrument, whose objects are shifted by a pixel: figures, files and refusals."""

from pathlib import Path

import numpy as np
import pytest
from commands import json_of

from pans.app.commands.refit import words_of
from pans.app.main import main
from pans.base import SHIPPED
from pans.bundle.sensor import load_bundle
from pans.calibrate.refit.clicks import Labelled, labelled_clicks, read_labels
from pans.record.reading import read_recording
from pans.record.replay import ClickLog, replay
from pans_sim.scene.still import load_scene

BUNDLE = SHIPPED / "fashion10.pans"
OBJECTS, TRIALS = 200, 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with shifted.npz and run.pansrec, the shipped fixed patterns on it."""
    found = tmp_path_factory.mktemp("refit")
    scene = load_scene("fashion200")
    moved = np.zeros_like(scene.images)
    moved[:, 1:, 1:] = scene.images[:, :-1, :-1]
    np.savez(found / "shifted.npz", images=moved, labels=scene.labels, classes=np.array(scene.classes))
    recorded(found, "run.pansrec", 1)
    return found


def recorded(folder: Path, name: str, seed: int, *more: str) -> Path:
    device = f"sim:oled-qcmos?scene={folder / 'shifted.npz'}&seed={seed}&pace=fast"
    many = ("--trials", str(TRIALS), "--decisions", str(OBJECTS * TRIALS), "--no-realtime", "-q")
    main(["run", str(BUNDLE), "--device", device, *many, "--record", str(folder / name), *more])
    return folder / name


def labels(folder: Path, name: str, recording: str = "", **changed: str) -> Path:
    """Write the scene's truth, and the `changed` ones (o3="Bag") as given; each line may name its `recording`."""
    scene = load_scene("fashion200")
    rows = [f"{number},{changed.get(f'o{number}', scene.classes[label])}" for number, label in enumerate(scene.labels)]
    lines = [f"{recording},{row}" if recording else row for row in ("object,label", *rows)]
    (folder / name).write_text("\n".join(lines).replace(recording, "recording", recording != "") + "\n")
    return folder / name


def test_a_refit_is_better_on_objects_held_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = folder / "new.pans"
    found = json_of(capsys, "refit", BUNDLE, folder / "run.pansrec", "-o", new)
    held = found["held_out"]
    assert (found["objects"], found["decisions"], found["simulated"]) == (OBJECTS, OBJECTS * TRIALS, True)
    assert found["changed"]
    assert held["log_loss_gain"]["low"] > 0
    assert held["accuracy_old"]["value"] == pytest.approx(
        read_recording(folder / "run.pansrec").summary["accuracy"], abs=1e-9
    )
    assert found["clicks_mean"] > 1 < found["photons_mean"] < found["illumination"]
    assert [row["objects"] for row in found["learning_curve"]] == [20, 40, 80, 160]
    assert found["more_objects"]["objects"] == 2 * found["objects"]
    bundle, sha256 = load_bundle(new)
    assert sha256 == found["sha256"]
    told = bundle.provenance["refit"]
    assert told["recordings"][0]["decisions"] == OBJECTS * TRIALS
    assert told["from_bundle_sha256"] == load_bundle(BUNDLE)[1]
    words = words_of(found)
    for word in ("SIMULATED", "accuracy", "clicks", "photons", "illumination"):
        assert word in words


@pytest.mark.slow
def test_clicks_that_no_fit_has_seen_are_decided_better(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    json_of(capsys, "refit", BUNDLE, folder / "run.pansrec", "-o", folder / "better.pans")
    other = read_recording(recorded(folder, "other.pansrec", 2))
    truth = other.decisions()["truth"]
    right = [(decided(other, load_bundle(path)[0]) == truth).mean() for path in (BUNDLE, folder / "better.pans")]
    assert right[1] > right[0] + 0.02  # 400 decisions on the same objects, other photons


def decided(recording, bundle):
    log = ClickLog()
    replay(recording, bundle, log)
    return np.array([decision.label for decision in log.decisions])


def test_labels_from_a_file_are_the_marks(folder: Path) -> None:
    bundle, sha256 = load_bundle(BUNDLE)

    def read(name: str, **changed: str) -> Labelled:
        found = read_labels(labels(folder, name, **changed), bundle.classes)
        return labelled_clicks(bundle, sha256, [folder / "run.pansrec"], found)

    by_file, by_marks = read("truth.csv"), labelled_clicks(bundle, sha256, [folder / "run.pansrec"], None)
    by_name = read("named.csv", recording="run.pansrec")
    for name in ("counts", "truth", "object_id"):
        assert np.array_equal(getattr(by_file, name), getattr(by_marks, name))
        assert np.array_equal(getattr(by_file, name), getattr(by_name, name))
    assert by_file.counts.sum(axis=1).tolist() == read_recording(folder / "run.pansrec").decisions()["clicks"].tolist()
    fewer = read("some.csv", **{f"o{number}": "" for number in range(0, 200, 4)}, o5="Bag", o6="8")
    assert (len(fewer.truth), len(np.unique(fewer.object_id)), fewer.left_out["without a label"]) == (300, 150, 100)
    assert fewer.truth[[6, 8]].tolist() == [8, 8]  # objects 5 and 6: 1, 2 and 3 were before, twice each


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    found = json_of(capsys, "refit", *words, code=2)
    return str(found["error"]["message"])


def test_what_cannot_be_refitted_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = folder / "run.pansrec", folder / "never.pans"
    assert "another bundle" in refusal(capsys, SHIPPED / "fashion-adaptive.pans", run, "-o", out)
    assert "same recording" in refusal(capsys, BUNDLE, run, run, "-o", out)
    head, *lines = labels(folder, "t.csv").read_text().splitlines(keepends=True)
    unknown = [f"{number},\n" for number in range(OBJECTS)]
    bad = {
        "3 objects are not in the labels, object 0 first": [head, *lines[3:]],
        "x.csv:9: the label is '17', allowed: 0 to 9": [head, *lines[:7], "7,17\n", *lines[8:]],
        "no object has a label": [head, *unknown],
        "too few labelled objects, allowed: 10": [head, *unknown[:100], *lines[100:]],
        "x.csv:202: object 5 has a label already": [head, *lines, "5,Bag\n"],
        "labels for 1 objects that the recordings do not have, object 200": [head, *lines, "200,Bag\n"],
        "x.csv:202: the object is '-1'": [head, *lines, "-1,Bag\n"],
        "x.csv:202: 3 values": [head, *lines, "1,2,3\n"],
        "allowed: object,label or recording,object,label": ["what,ever\n"],
        "labels of 'a', which 0 of the recordings are called": ["recording," + head, *(f"a,{line}" for line in lines)],
    }
    for said, text in bad.items():
        (folder / "x.csv").write_text("".join(text))
        assert said in refusal(capsys, BUNDLE, run, "--labels", folder / "x.csv", "-o", out)
    assert "is once of class" in refusal(capsys, BUNDLE, run, "--cycle", 7, "-o", out)
    assert not out.exists()
