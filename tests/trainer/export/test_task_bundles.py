"""Every task: a tiny training, its bundle, the runtime's decisions on it; passive sensors and pictures through a whole run."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from trainings import short_fits  # noqa: F401  a fixture

from pans.app.main import main
from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor.bundle import load_bundle
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import evaluate_pictures, light_of
from pans_trainer.export.writer import export_trained, reference_scores
from pans_trainer.options import Options
from pans_trainer.tasks.public_sets import PUBLIC_SETS
from pans_trainer.tasks.registry import FIBRE_TASKS, Objects, Task, draw_task, physical_encoder, task_names
from pans_trainer.train.gradient.data import encoder_input
from pans_trainer.train.gradient.loop import train

PROFILE = load_profile("ideal")
pytestmark = pytest.mark.usefixtures("short_fits")


def small_task(name):
    """The task with few objects; in place of a public set, noise that looks like one."""
    if name not in PUBLIC_SETS and name not in FIBRE_TASKS:
        return draw_task(name, seed=1, n_train=48, n_test=16)
    rng = np.random.default_rng(3)
    parts = [Objects(rng.integers(0, 256, (n, 28, 28), dtype=np.uint8), rng.integers(0, 10, n)) for n in (48, 16)]
    task = Task(name, tuple("0123456789"), *parts, sha256="0" * 64, split="the test part of the data")
    if name in FIBRE_TASKS:
        task = replace(task, light="field", optics="mmf", target=FIBRE_TASKS[name])
    return task


def made(tmp_path, name, **changed):
    task = small_task(name)
    is_picture = task.target == "image"
    small = {"features": 3, "alpha": 0.0, "epochs": 1, "hidden": 8, "batch": 16, "encoder": physical_encoder(task)}
    small |= {"head": "picture" if is_picture else "mlp", "estimator": "ste" if is_picture else "exact"}
    trained = train(task, PROFILE, Options(**small | changed))
    path = tmp_path / f"{name}.pans"
    return task, trained, path, export_trained(path, trained, task, PROFILE, name=name, provenance={})


@pytest.mark.parametrize(
    ("name", "changed"), [*((name, {}) for name in task_names()), ("mmf-mnist-image", {"head": "decoder"})]
)
def test_every_task_gives_a_bundle_that_decides_as_its_model(name, changed, tmp_path):
    task, trained, path, exported = made(tmp_path, name, **changed)
    bundle, digest = load_bundle(path)
    assert digest == exported.sha256
    assert exported.words_compared == 8
    assert exported.score_difference <= 1e-5
    assert bundle.encoder == physical_encoder(task)
    assert (bundle.analyser is None) == (bundle.encoder == "active")
    counts = np.array([[word >> i & 1 for i in range(3)] for word in range(8)])
    wanted = reference_scores(trained.head, trained.click_mean.numpy(), counts.astype(np.float32))
    decider = make_decider(bundle)
    assert decider.scores_batch(counts, 1) == pytest.approx(wanted, abs=1e-5 * max(1, np.abs(wanted).max()))
    if task.target == "image":
        assert bundle.picture_shape == task.image_shape
        assert decider.pictures(counts, 1).shape == (8, *task.image_shape)
    assert bundle.provenance["task_light"] == task.light
    assert bundle.provenance["task_optics"] == task.optics
    assert main(["verify", str(path)]) in (0, 1)  # one epoch may leave a class undecided: an alert


@pytest.mark.parametrize("changed", [{}, {"complex_field": True}, {"conserving": True, "input_photons": 30.0}])
def test_the_light_of_a_passive_bundle_is_the_trained_encoder_s(changed, tmp_path):
    task, trained, _, exported = made(tmp_path, "mmf-mnist", **changed)
    shown = encoder_input(task, task.test, PROFILE, trained.options)
    with torch.no_grad():
        wanted = trained.encoder(shown).double().numpy()
    light = light_of(exported.bundle, PROFILE, task.test.images)
    assert light.photoelectrons == pytest.approx(wanted, rel=1e-3, abs=1e-4)  # float32 sums of 784 terms
    assert light.illumination == 0
    assert np.iscomplexobj(exported.bundle.analyser.matrix) == trained.options.complex_field


def scene(tmp_path, task):
    path, held_out = tmp_path / "scene.npz", task.test
    np.savez(path, images=held_out.images, labels=held_out.labels, classes=np.array(task.classes))
    return path


def ran(tmp_path, pans, path, device, *more):
    code = main(["run", str(path), "--device", device, "--profile", "ideal", "--out", str(tmp_path), "--json", *more])
    return code, json.loads(pans.said().out)


@pytest.mark.parametrize(("name", "changed"), [("tissue", {}), ("mmf-mnist", {"complex_field": True, "head": "conv"})])
def test_a_passive_bundle_runs_on_an_instrument_with_its_optics(name, changed, tmp_path, pans):
    task, _, path, exported = made(tmp_path, name, **changed)
    device = f"sim:ideal?pace=fast&seed=3&scene={scene(tmp_path, task)}"
    code, found = ran(tmp_path, pans, path, f"{device}&optics={path}", "--decisions", "64", "--trials", "4")
    assert code == 0, found["faults"]
    assert found["decisions"] == 64
    light = light_of(exported.bundle, PROFILE, task.test.images)
    assert found["photons_mean"] == pytest.approx(light.photoelectrons.sum() / 16, rel=1e-5)
    clicks = light.probability.sum() / 16
    assert found["clicks_mean"] == pytest.approx(clicks, abs=5 * (3 * 0.25 / 64) ** 0.5)
    assert found["illumination"] == 0
    assert pans("replay", found["recording"])["identical"]
    assert main(["verify", found["recording"], "--json"]) in (0, 1)
    assert not json.loads(pans.said().out)["violations"]
    words = ("run", path, "--device", device, "--profile", "ideal", "--out", tmp_path / "none")
    assert "optics=BUNDLE.pans" in pans.refuses(*words, code=3)  # an instrument with a projector, or another's glass
    assert pans("info", path)["sensor"]["fingerprint"] == exported.bundle.analyser.fingerprint


def test_a_picture_bundle_runs_and_its_pictures_are_recomputed(tmp_path, pans):
    task, _, path, exported = made(tmp_path, "mmf-mnist-image")
    where = scene(tmp_path, task)
    device = f"sim:ideal?pace=fast&seed=3&scene={where}&optics={path}"
    code, found = ran(tmp_path, pans, path, device, "--decisions", "16")
    assert code == 0, found["faults"]
    assert (found["decisions"], found["accuracy"], found["abstained"]) == (16, None, 0)
    out = tmp_path / "pictures.npz"
    words = ["replay", found["recording"], "--json", "--pictures", str(out), "--truth", str(where)]
    replayed = pans(*words)
    assert replayed["identical"]
    with np.load(out, allow_pickle=False) as arrays:
        assert arrays["pictures"].shape == (16, 28, 28)
        assert arrays["object"].tolist() == list(range(16))
        wanted = ((arrays["pictures"] - task.test.images / 255) ** 2).mean()
    assert replayed["mse_mean"] == pytest.approx(wanted, rel=1e-5)
    light = light_of(exported.bundle, PROFILE, task.test.images)
    expected = evaluate_pictures(exported.bundle, light, task.test.images, trials=20)
    assert replayed["ssim_mean"] == pytest.approx(expected.ssim_mean, abs=6 * expected.ssim_std + 1e-6)
    assert main(["verify", found["recording"]]) == 0
    assert main(["report", found["recording"], "-o", str(tmp_path / "run.html")]) == 0
    page = (tmp_path / "run.html").read_text()
    assert "row 0" in page
    assert "modulus of W" in page
