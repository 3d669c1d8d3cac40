"""`import pans`: what a notebook needs, with the same figures as the commands give."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, diamond, random_automaton
from tree import ROOT

import pans
from pans.base.console.extras import INSTALLS, install
from pans.base.errors import UsageError

DEVICE = "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast"


def test_a_run_leaves_a_recording_that_replays_and_a_page(tmp_path: Path) -> None:
    done = pans.run("fashion10", DEVICE, decisions=40, out=tmp_path)
    assert (done.summary.verdict, done.summary.decisions, done.confusion.sum()) == ("PASS", 40, 40)
    assert "SIMULATED" in done.report.read_text()
    assert done.recording is not None
    recording = pans.load_recording(done.recording)
    again = pans.replay(recording, recording.bundle())
    assert (again.decisions, again.sha256) == (40, done.summary.decisions_sha256)


def test_a_run_without_a_folder_leaves_nothing_and_decides_the_same(tmp_path: Path) -> None:
    bundle = pans.load_bundle("fashion10")
    done = pans.run(bundle, DEVICE, decisions=40, profile=pans.load_profile("oled-qcmos"))
    assert (done.recording, done.report) == (None, None)
    recorded = pans.run(bundle, DEVICE, decisions=40, out=tmp_path)
    np.testing.assert_array_equal(done.confusion, recorded.confusion)


def test_words_and_counts_are_decided_alike_and_checked() -> None:
    bundle = pans.load_bundle("fashion10")
    words = np.arange(1 << bundle.n_features)
    counts = words[:, None] >> np.arange(bundle.n_features) & 1
    found, wanted = pans.decide(bundle, words), pans.decide(bundle, counts)
    np.testing.assert_array_equal(found.labels, wanted.labels)
    np.testing.assert_array_equal(found.probabilities, wanted.probabilities)
    for wrong in ([-1], [1 << bundle.n_features], [[2] * bundle.n_features], [[0, 1]]):
        with pytest.raises(UsageError, match="allowed"):
            pans.decide(bundle, wrong)


def test_an_automaton_decides_on_words_and_long_words_are_counts() -> None:
    short, long = automaton_bundle(diamond()), automaton_bundle(random_automaton(1, slots=70, width=2))
    for clicks in ([0b000, 0b111], [[0, 0, 0], [1, 1, 1]]):
        assert pans.decide(short, clicks).labels.tolist() == [0, 1]
    with pytest.raises(UsageError, match="at most 63 clicks"):
        pans.decide(long, [1])
    assert len(pans.decide(long, np.zeros((2, 70), int)).labels) == 2


@pytest.mark.parametrize(
    ("missing", "name", "extra"),
    [(("torch",), "train", "train"), (("sklearn", "torch", "onnx"), "PansClassifier", "sklearn")],
)
def test_without_its_extra_a_name_says_what_to_install_and_help_works(
    missing: tuple[str, ...], name: str, extra: str
) -> None:
    hidden = f"import pydoc, sys; sys.modules |= dict.fromkeys({missing}); import pans"
    there = f"from pans import *; print({name!r} in globals(), hasattr(pans, {name!r}), getattr(pans, {name!r}, None))"
    code = f"{hidden}; {there}; print(*dir(pans)); print(pydoc.plain(pydoc.render_doc(pans))); "
    for ask, error in ((f"from pans import {name}", "ImportError"), (f"pans.{name}", "MissingExtraError")):
        done = subprocess.run([sys.executable, "-c", code + ask], capture_output=True, text=True)
        found, names, told = done.stdout.split("\n", 2)
        assert found == "False False None"
        assert {"load_recording", "run"} <= set(names.split()) <= {*pans.__all__} - {name}
        assert "load_recording" in told
        assert f"{error}: pans.{name} needs the package {missing[0]}, which is not installed" in done.stderr
        assert install(extra) in done.stderr


def test_what_is_installed_for_an_extra_are_its_packages() -> None:
    """Never this package's own name, which is free on the index; limits stand where there is an upper one."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, words in INSTALLS.items():
        wanted = []
        for row in extras[extra]:
            inner = re.fullmatch(r"pans-runtime\[(.*)\]", row)
            wanted += [one for name in inner[1].split(",") for one in extras[name]] if inner else [row]
        named = [row if "==" in row or "<" in row else row.partition(">=")[0] for row in wanted]
        assert shlex.split(words) == named, extra


def test_no_remedy_installs_this_package_from_the_index() -> None:
    files = [file for top in ("runtime", "trainer", "firmware_sim") for file in (ROOT / top).rglob("*.py")]
    assert not [file for file in files if re.search(r"pip install [^\n]*pans-runtime", file.read_text())]


def test_results_are_tables_in_a_notebook_and_frames_of_pandas(tmp_path: Path) -> None:
    done = pans.run("fashion10", DEVICE, decisions=20, out=tmp_path, dark_slots=2)
    assert repr(done).startswith("<Run: PASS, 20 decisions, recording ")
    assert done.summary.dark.exposures == 40
    with pytest.raises(UsageError, match="no option dark_slits"):
        pans.run("fashion10", DEVICE, decisions=20, dark_slits=2)
    recording = pans.load_recording(done.recording or "")
    again = pans.replay(recording, recording.bundle())
    assert ("as recorded", "yes") in cells(again._repr_html_())
    assert "as_recorded=True" in repr(again)

    pytest.importorskip("torch", reason="needs the train extra")
    images = np.zeros((60, 4, 4), np.uint8)
    images[::2, :, :2] = images[1::2, :, 2:] = 255
    said: list[float] = []
    small: dict[str, Any] = {"exposures": 5, "states": 4, "epochs": 1, "folds": 1}
    results = pans.train(images, ["<b>", "right"] * 30, progress=lambda _, part: said.append(part), **small)
    assert 0.8 < results.accuracy <= 1.0
    assert max(said) == 1.0
    frame = pytest.importorskip("pandas") and results.to_frame()
    assert frame.loc["sensor", "accuracy"] == results.accuracy
    camera = results.camera_at_equal_photons
    assert camera is not None
    assert frame.loc["camera at equal photons", "photons"] == camera.photons
    assert ("accuracy", f"{100 * results.accuracy:.1f} ± {100 * results.accuracy_se:.1f} %") in cells(
        results._repr_html_()
    )
    scene = tmp_path / "scene.npz"
    np.savez(scene, images=images, labels=[0, 1] * 30, classes=results.classes)
    measured = pans.evaluate(results.sensor, task=str(scene))
    assert isinstance(measured, pans.MeasuredWalks)
    assert ("photons", f"{measured.photons_mean:.2f}") in cells(measured._repr_html_())
    assert measured.to_frame().loc["sensor", "clicks_mean"] == measured.clicks_mean


def cells(card: str) -> list[tuple[str, str]]:
    """The rows of an HTML card: name and value."""
    return re.findall(r"<tr><th>(.*?)</th><td>(.*?)</td></tr>", card)


@pytest.mark.parametrize("clicks", [[0.5], [1.0], ["a"], [None], "abc", {}, [[1, 2], [3]], [[0.5] * 10], [2**70]])
def test_clicks_that_are_no_whole_numbers_are_refused(clicks: Any) -> None:
    with pytest.raises(UsageError, match=r"^clicks are"):
        pans.decide(pans.load_bundle("fashion10"), clicks)


def test_no_clicks_and_true_or_false_are_clicks_too() -> None:
    bundle = pans.load_bundle("fashion10")
    assert len(pans.decide(bundle, []).labels) == 0
    truths = np.array([[True, False] * 5])
    assert pans.decide(bundle, truths).labels == pans.decide(bundle, truths.astype(int)).labels


def test_every_public_name_is_listed_before_it_is_used() -> None:
    pytest.importorskip("torch", reason="needs the train extra")
    pytest.importorskip("sklearn", reason="needs the sklearn extra")
    code = "import pans; print(sorted({*pans.__all__} - {*dir(pans)}), all(hasattr(pans, name) for name in dir(pans)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[] True\n"
