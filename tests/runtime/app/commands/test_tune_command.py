"""`pans tune` on the simulated instrument, whose objects are shifted by a pixel: through the real driver, ended, resumed, refused."""

import json
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from commands import Pans

from pans.base import SHIPPED
from pans.bundle.sensor import load_bundle
from pans_sim.scene.still import load_scene

BUNDLE = SHIPPED / "fashion10.pans"


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The URL of an instrument whose 200 objects stand one pixel further right and down."""
    found = tmp_path_factory.mktemp("tune") / "shifted.npz"
    scene = load_scene("fashion200")
    moved = np.zeros_like(scene.images)
    moved[:, 1:, 1:] = scene.images[:, :-1, :-1]
    np.savez(found, images=moved, labels=scene.labels, classes=np.array(scene.classes))
    return f"sim:oled-qcmos?scene={found}&seed=1&pace=fast"


def tune(pans, device: str, out: Path, *more: object, code: int = 0):
    return pans("tune", BUNDLE, "--device", device, "--only", "shift", "-o", out, *more, code=code)


@pytest.mark.slow
def test_a_budget_ends_it_whole_and_it_can_be_resumed(device: str, tmp_path: Path, pans: Pans) -> None:
    out = tmp_path / "tuned.pans"
    first = tune(pans, device, out, "--objects", 100, "--photons", 21_500)  # of 41 photons: a trial takes 4150
    assert (first["trials"], first["ended"], first["objects"]) == (3, "the budget is spent", 100)
    assert first["spent"]["photons_or_clicks"] < 21_500
    told = load_bundle(out)[0].provenance["tune"]
    assert told["from_bundle_sha256"] == load_bundle(BUNDLE)[1]
    kept = json.loads((tmp_path / "tuned.pans.tune.json").read_text())
    assert len(kept["trials"]) == 3
    assert "a tuning was begun here" in tune(pans, device, out, code=2)["error"]["message"]
    again = tune(pans, device, out, "--objects", 100, "--photons", 26_000, "--resume")
    assert again["trials"] == 4
    assert json.loads((tmp_path / "tuned.pans.tune.json").read_text())["trials"][:3] == kept["trials"]
    other = tune(pans, device.replace("seed=1", "seed=2"), out, "--objects", 100, "--resume", code=2)
    assert "its device is" in other["error"]["message"]


def test_an_interrupt_leaves_a_whole_bundle_and_a_checkpoint(device: str, tmp_path: Path, pans: Pans) -> None:
    out, checkpoint = tmp_path / "cut.pans", tmp_path / "cut.pans.tune.json"
    done = threading.Event()

    def interrupt() -> None:
        while not (checkpoint.exists() and len(json.loads(checkpoint.read_text())["trials"]) >= 2) and not done.wait(
            0.01
        ):
            pass
        if not done.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    waiting = threading.Thread(target=interrupt)
    waiting.start()
    try:
        found = tune(pans, device, out, "--objects", 100, code=130)
    finally:
        done.set()
        waiting.join()
    assert (found["interrupted"], found["comparison"]) == (True, None)
    assert found["trials"] >= 2
    assert load_bundle(out)[1] == found["sha256"]
    assert len(json.loads(checkpoint.read_text())["trials"]) == found["trials"]


def test_what_cannot_be_tuned_is_refused(device: str, tmp_path: Path, pans: Pans) -> None:
    out = tmp_path / "never.pans"
    (tmp_path / "few.csv").write_text("object,label\n" + "".join(f"{n},{n % 10}\n" for n in range(40)))
    refused = [
        (("--resume",), "there is no checkpoint"),
        (("--labels", tmp_path / "few.csv"), "40 objects, allowed: 100 or more"),
        (("--labels", tmp_path / "few.csv", "--objects", 100), "32 labelled objects to tune on and 8 held out"),
    ]
    for words, said in refused:
        found = tune(pans, device, out, *words, code=2)
        assert said in found["error"]["message"]
    with pytest.raises(SystemExit):
        tune(pans, device, out, "--only", "colour")
    assert "'colour', allowed: some of shift" in pans.said().err
    assert not out.exists()


@pytest.mark.slow
def test_a_tuned_sensor_is_better_on_held_out_objects(device: str, tmp_path: Path, pans: Pans) -> None:
    found = tune(pans, device, tmp_path / "tuned.pans")
    compared = found["comparison"]
    assert compared["held_out"]["objects"] == 40
    assert compared["all_objects"]["accuracy_gain"]["low"] > 0.05
    assert found["ended"] == "the smallest steps change nothing more"
