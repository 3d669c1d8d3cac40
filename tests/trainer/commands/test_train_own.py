"""`pans train FOLDER`: what is chosen is told and kept, and the commands that it ends with run the bundle."""

import json
import shlex

import numpy as np
import pytest
from trainings import practice_folder, practice_images

from pans.app.main import main
from pans.bundle.sensor.bundle import load_bundle
from pans_trainer.baselines import rows
from pans_trainer.commands import train_own
from pans_trainer.commands.arguments import curve
from pans_trainer.own_images import own, recipe
from pans_trainer.tasks.registry import load_task

QUICK = ["--exposures", "4", "--states", "8", "--epochs", "1"]


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(recipe, "OBJECTS", 400)
    monkeypatch.setattr(train_own, "RUN_DECISIONS", 40)
    monkeypatch.setattr(rows, "EQUAL_TRIALS", 2)
    monkeypatch.setattr(own, "FEW_HELD_OUT", 2)


@pytest.fixture
def letters(tmp_path, monkeypatch):
    practice_folder(tmp_path / "my letters", "letters", 150)
    monkeypatch.chdir(tmp_path)
    return "my letters"


def test_a_folder_needs_no_option_and_the_next_commands_work(letters, pans):
    assert main(["train", letters, *QUICK, "-o", "letters.pans"]) == 0
    said = pans.said()
    assert "400 training images from 120" in said.err
    assert "an automaton" in said.err
    assert "at which a camera detects 10" in said.err
    assert "class 'H' has 24 training images" in said.err
    assert "camera, equal photons" in said.out
    assert "recall by class" in said.out
    following = [shlex.split(line)[1:] for line in said.out.partition("next:")[2].split("\n") if line.strip()]
    assert [words[0] for words in following] == ["data", "run", "report"]
    for words in following:
        assert main(words) == 0, words
    bundle, _ = load_bundle("letters.pans")
    assert bundle.automaton is not None
    assert bundle.provenance["training_objects"] == 400 + 10  # those kept apart have no copies
    assert bundle.provenance["variation"]
    options, camera = bundle.provenance["options"], load_task(letters)
    assert options["photons"] == 10.0
    assert options["illumination"] * camera.train.images.mean() / 255 == pytest.approx(10, rel=0.05)
    assert bundle.expected["objects"] == 30


def test_a_messy_folder_is_trained_on_by_one_command(tmp_path, monkeypatch, pans):
    """Photos of 20 to 300 pixels in all kinds of files, one damaged, one twice, few of one class."""
    counts = {"disc": 30, "square": 20, "triangle": 6}
    practice_images().draw_photos(tmp_path / "photos", np.random.default_rng(0), counts.items(), largest=300)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recipe, "TRIES", {"turn_deg": (25.0,)})
    assert "disc/damaged.jpg" in (refused := pans.refuses("train", "photos", *QUICK, "-o", "p.pans"))
    assert "--skip-bad" in refused
    assert main(["train", "photos", "--skip-bad", "--resize", "16", *QUICK, "-o", "p.pans", "--json"]) == 0
    said = pans.said()
    for words in (
        "--resize 16",
        "colour to grey",
        "transparent",
        "of 16 bits",
        "EXIF",
        "duplicate: disc/copy",
        "refused: disc/damaged",
    ):
        assert words in said.err, words
    answer = json.loads(said.out)
    read, found = answer["read"]["classes"], answer["results"]
    assert [(row["files"], row["taken"], row["duplicates"]) for row in read.values()] == [
        (32, 30, 1),
        (21, 20, 1),
        (7, 6, 1),
    ]
    assert (found["folds"], found["images"]) == (5, counts)
    for camera in ("camera_at_equal_photons", "camera_at_equal_illumination"):
        assert {"balanced_accuracy_gain", "balanced_accuracy_gain_se", "clicks", "photons", "illumination"} <= found[
            camera
        ].keys()
    for name in ("seen", "confused"):
        assert (tmp_path / f"p-{name}.png").read_bytes()[:4] == b"\x89PNG"
    again = pans("evaluate", "p.pans")  # reads the photos as the training did
    assert again["accuracy_mean"] == pytest.approx(answer["accuracy_mean"])
    assert "exists" in pans.refuses("train", "photos", "--skip-bad", *QUICK, "-o", "p.pans")
    assert main(["data", "scene", "photos", "--skip-bad", "--resize", "16", "-o", "p.npz"]) == 0
    assert np.load("p.npz")["images"].shape == (11, 16, 16)


@pytest.mark.parametrize("whole", [0, 1])
def test_an_interrupted_training_leaves_its_sensor_and_the_results_so_far(letters, pans, monkeypatch, whole):
    """Ctrl-C while the sensor after so many is judged; the first one is written before that."""
    monkeypatch.setattr(recipe, "TRIES", {"turn_deg": (25.0,)})
    done, judged = [], own.judged

    def judged_until(*given):
        if len(done) == whole:
            raise KeyboardInterrupt
        done.append(judged(*given))
        return done[-1]

    monkeypatch.setattr(own, "judged", judged_until)
    assert main(["train", letters, *QUICK, "--folds", "4", "-o", "letters.pans", "--json"]) == 130
    said = pans.said()
    answer = json.loads(said.out)
    assert answer["interrupted"]
    assert load_bundle("letters.pans")[1] == answer["sha256"]
    if not whole:
        assert "results" not in answer
        return
    found = answer["results"]
    assert (found["folds"], found["folds_missing"], sum(found["images"].values())) == (1, 3, 30)
    first, rest = said.err.split("letters.pans is whole")
    assert "SIMULATED, 30 held-out images" in first
    assert "3 more sensors are trained for the figures alone, which takes about" in rest


def test_as_is_chooses_nothing(letters, pans):
    assert "--features is missing" in pans.refuses("train", letters, "--as-is", "-o", "letters.pans")
    words = ["train", letters, "--as-is", "--encoder", "automaton", "--photons", "5", *QUICK, "-o", "letters.pans"]
    assert main(words) == 0
    said = pans.said()
    assert "chosen from the images" not in said.err
    assert "next:" not in said.out
    assert "variation" not in load_bundle("letters.pans")[0].provenance


def test_an_option_of_fixed_patterns_asks_for_them(letters, pans, monkeypatch):
    monkeypatch.setattr(recipe, "FIXED_STEPS", 40)
    monkeypatch.setattr(recipe, "FIXED_EPOCHS", (8, 8))
    words = ["--features", "3", "--hidden", "8", "--estimator", "ste", "--profile", "ideal"]
    assert main(["train", letters, *words, "-o", "letters.pans"]) == 0
    said = pans.said()
    assert "8 epochs in batches of" in said.err
    assert "camera, equal photons" in said.out
    assert load_bundle("letters.pans")[0].pattern_levels.shape[0] == 3


def test_the_course_of_an_automaton_is_written_and_the_answer_holds_direct_imaging(letters, tmp_path, pans):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    more = ["--photons", "5", "--history", "course", "-o", "letters.pans", "--json"]
    answer = pans("train", letters, *QUICK, *more)
    assert answer["direct_imaging"]["photons_mean"] == pytest.approx(answer["photons_mean"], rel=1e-3)
    assert 0.1 < answer["direct_imaging"]["accuracy_mean"] < 1
    gentle = answer["direct_imaging_as_illuminated"]
    assert gentle["illumination"] == pytest.approx(answer["illumination"], rel=1e-3)
    again = pans("evaluate", "letters.pans")  # against the same changed copies, the same readouts
    for key in ("direct_imaging", "direct_imaging_as_illuminated"):
        assert again[key] == pytest.approx(answer[key])
    assert "direct_imaging" not in pans("evaluate", "letters.pans", "--no-compare")
    course = json.loads((tmp_path / "course/history.json").read_text())
    stages = [step["stage"] for step in course["epochs"]]
    assert stages == ["grow"] * 4 + ["grey"] * 3 + ["shown"]
    assert (tmp_path / "course/curves.png").read_bytes()[:4] == b"\x89PNG"
    assert main(["train", letters, *QUICK, "--history", "course", "-o", "again.pans"]) == 2  # nothing is replaced


def test_a_sensor_that_always_names_the_largest_class_is_warned_of(tmp_path, monkeypatch, pans):
    """Squares, bars and few crosses, 298:32:6, and a training too short for any of them but the squares."""
    rng, labels = np.random.default_rng(0), np.repeat([0, 1, 2], [298, 32, 6])
    images = np.zeros((len(labels), 8, 8), np.uint8)
    for image, label in zip(images, labels):
        row, column = rng.integers(0, 5, 2)
        image[row : row + 4 if label != 1 else 8, column : column + (4 if label == 0 else 1)] = 200
    monkeypatch.chdir(tmp_path)
    np.savez("unequal.npz", images=images, labels=labels, classes=np.array(["square", "bar", "cross"]))
    quick = ["--as-is", "--features", "4", "--encoder", "active", "--epochs", "1"]
    assert main(["train", "unequal.npz", *quick, "-o", "s.pans", "--json"]) == 0
    said = pans.said()
    found = json.loads(said.out)["by_class"]
    held_out = labels[4::5]
    assert found["majority_class"] == "square"
    assert found["majority_share"] == pytest.approx(np.mean(held_out == 0))
    assert found["recall"] == pytest.approx({"square": 1.0, "bar": 0.0, "cross": 0.0}, abs=0.01)
    assert found["balanced_accuracy"] == pytest.approx(1 / 3, abs=0.01)
    assert not found["better_than_majority"]
    assert "not better than always naming the largest class, 'square'" in said.err
    assert "class 'cross' has 5 training images" in said.err
    assert "'square' has 239 training images, 'cross' has 5: every class counts the same" in said.err
    assert main(["evaluate", "s.pans", "--task", "unequal.npz", "--exact"]) == 0
    said = pans.said()
    assert "not better than always naming the largest class" in said.err
    assert "balanced accuracy       33.33 %; recall bar 0.00 %, cross 0.00 %, square 100.00 %" in said.out
    assert "at equal illumination" in said.out
    np.savez("others.npz", images=images[::-1], labels=labels[::-1], classes=np.array(["square", "bar", "cross"]))
    others = ["evaluate", "s.pans", "--task", "others.npz", "--exact"]  # all held out: a camera has none to learn from
    assert main(others) == 0
    assert "direct imaging" not in pans.said().out
    assert "training images are not at hand" in pans.refuses(*others, "--compare")


def test_a_curve_is_thinned_and_says_its_ends():
    assert curve([]) == ""
    assert curve([5.0]) == "▁  5 to 5, now 5"
    rising = curve(list(np.linspace(0, 100, 400)), width=8)
    assert rising.startswith("▁▂▃▄▅▆▇█ ")
    assert rising.endswith("now 100")
