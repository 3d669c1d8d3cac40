"""`pans.PansClassifier`: scikit-learn's own checks, clicks that are drawn, and what it says against independent sums."""

import copy
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import torch

import pans
from pans.base.errors import PlanError, UsageError
from pans.bundle.backends.choose import make_decider

sklearn = pytest.importorskip("sklearn", reason="needs the sklearn extra")
from sklearn.base import clone  # noqa: E402
from sklearn.datasets import load_digits  # noqa: E402
from sklearn.model_selection import GridSearchCV, cross_val_score  # noqa: E402
from sklearn.pipeline import make_pipeline  # noqa: E402
from sklearn.preprocessing import MinMaxScaler  # noqa: E402
from sklearn.utils.estimator_checks import parametrize_with_checks  # noqa: E402

from pans_trainer.own_images import estimator  # noqa: E402
from pans_trainer.own_images.estimator import PansClassifier  # noqa: E402

SMALL: dict[str, Any] = {"features": 5, "photons": 4, "epochs": 1, "random_state": 0}
FIXED = SMALL | {"encoder": "active", "features": 3, "options": {"hidden": 8}}
IMAGES, DIGITS = load_digits(n_class=3, return_X_y=True)
NAMES = np.array(["zero", "one", "two"])[DIGITS]


@parametrize_with_checks([PansClassifier(**SMALL, scale="largest")])
def test_the_checks_of_scikit_learn_pass(estimator: Any, check: Any) -> None:
    check(estimator)


@pytest.mark.slow
@parametrize_with_checks([PansClassifier(**FIXED, scale="largest")])
def test_they_pass_of_fixed_patterns_too(estimator: Any, check: Any) -> None:
    check(estimator)


def test_it_computes_on_one_thread_and_leaves_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many small steps: on two threads `fit` took 13 times as long."""
    used, before = [], torch.get_num_threads()
    trained = PansClassifier._trained
    monkeypatch.setattr(
        PansClassifier, "_trained", lambda *given: (used.append(torch.get_num_threads()), trained(*given))[1]
    )
    torch.set_num_threads(2)
    try:
        PansClassifier(**SMALL, scale="largest").fit(IMAGES[:30], DIGITS[:30])
        assert (used, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("given", [SMALL, FIXED])
def test_verbose_says_how_far_the_training_is(monkeypatch: pytest.MonkeyPatch, given: dict[str, Any]) -> None:
    told: list[float] = []
    monkeypatch.setattr(estimator, "work_bar", lambda: nullcontext(lambda _words, part: told.append(part)))
    PansClassifier(**given, scale=16).fit(IMAGES[:30], DIGITS[:30])
    assert not told
    PansClassifier(**given, scale=16, verbose=1).fit(IMAGES[:30], DIGITS[:30])
    assert told == sorted(told)
    assert told[-1] == 1


@pytest.fixture(scope="module", params=["automaton", "active"])
def sensor(request: pytest.FixtureRequest) -> PansClassifier:
    given = SMALL | {"scale": 16, "features": 6}
    if request.param == "active":
        given |= {"encoder": "active", "features": 4, "epochs": 20, "options": {"hidden": 16}}
    return PansClassifier(**given).fit(IMAGES[:300].reshape(-1, 8, 8), NAMES[:300])


def test_decisions_on_drawn_clicks_are_right_as_often_as_expected(sensor: PansClassifier) -> None:
    many, names = np.repeat(IMAGES[300:400], 100, axis=0), np.repeat(NAMES[300:400], 100)
    expected = sensor.expected_score(IMAGES[300:400], NAMES[300:400])
    assert 0.5 < expected < 0.99
    right = sensor.predict(many) == names
    # within an image decisions are independent: the variance of the mean is at most p (1 - p) / n
    assert abs(right.mean() - expected) < 5 * np.sqrt(expected * (1 - expected) / len(right))
    assert right.reshape(100, 100).std(axis=1).max() > 0.3  # the same image has other clicks each time


def test_the_clicks_of_an_image_do_not_depend_on_the_others(sensor: PansClassifier) -> None:
    whole, order = sensor.predict_proba(IMAGES), np.random.default_rng(0).permutation(len(IMAGES))
    np.testing.assert_array_equal(sensor.predict_proba(IMAGES[order]), whole[order])
    np.testing.assert_array_equal(np.concatenate([sensor.predict_proba(one[None]) for one in IMAGES[:9]]), whole[:9])
    np.testing.assert_array_equal(sensor.predict(IMAGES), sensor.classes_[whole.argmax(axis=1)])
    np.testing.assert_allclose(whole.sum(axis=1), 1.0, rtol=1e-5)


def test_a_bundle_decides_as_its_sensor_and_runs(sensor: PansClassifier, tmp_path: Any) -> None:
    digest = sensor.save(tmp_path / "sensor.pans")
    loaded = pans.load_bundle(tmp_path / "sensor.pans")
    assert (loaded.sha256, loaded.classes) == (digest, ("one", "two", "zero"))
    scene = tmp_path / "scene.npz"
    grey = np.rint(IMAGES.reshape(-1, 8, 8) * (255 / 16)).astype(np.uint8)
    np.savez(scene, images=grey, labels=np.searchsorted(sensor.classes_, NAMES), classes=sensor.classes_)
    done = pans.run(sensor.bundle_, f"sim:ideal?scene={scene}&pace=fast&seed=1", decisions=len(grey))
    found, wanted = done.summary.as_json(), sensor.measure(IMAGES, NAMES)
    assert abs(found["accuracy"] - wanted.accuracy_mean) < 5 * np.sqrt(0.25 / len(grey))
    assert abs(found["clicks_mean"] - wanted.clicks_mean) < 5 * np.sqrt(wanted.clicks_mean / len(grey))


def test_a_saved_bundle_states_what_it_achieves_on_images_that_were_held_out(
    sensor: PansClassifier, tmp_path: Any
) -> None:
    path, held = tmp_path / "sensor.pans", (IMAGES[300:], NAMES[300:])
    sensor.save(path)
    with pytest.raises(UsageError) as refused:
        sensor.save(path)
    assert refused.value.remedy == "choose another name, or replace it with force=True"
    if sensor.bundle_.automaton is None:
        with pytest.raises(UsageError, match="expected figures belong to one"):
            sensor.save(path, *held, force=True)
        return
    sensor.save(path, *held, force=True)
    told, found = pans.load_bundle(path).expected, sensor.measure(*held)
    assert told is not None
    assert (told["split"], told["objects"], told["profile"]) == ("held-out images", len(held[0]), "ideal")
    assert [told[name] for name in ("accuracy", "clicks", "photons", "illumination")] == pytest.approx(
        [found.accuracy_mean, found.clicks_mean, found.photons_mean, found.illumination]
    )
    scene = tmp_path / "scene.npz"
    grey = np.rint(held[0].reshape(-1, 8, 8) * (255 / 16)).astype(np.uint8)
    np.savez(scene, images=grey, labels=np.searchsorted(sensor.classes_, held[1]), classes=sensor.classes_)
    done = pans.run(path, f"sim:ideal?scene={scene}&pace=fast&seed=1", decisions=10 * len(grey), trials=10)
    assert done.summary.accuracy == done.summary.as_json()["accuracy"]
    assert abs(done.summary.walks.expected_off_stderr) < 5
    with pytest.raises(AttributeError, match="accurracy"):
        _ = done.summary.accurracy


def test_it_is_a_model_like_any_other() -> None:
    fast = PansClassifier(**SMALL)
    pipeline = make_pipeline(MinMaxScaler(clip=True), clone(fast))
    assert cross_val_score(pipeline, IMAGES, NAMES, cv=3).mean() > 0.6  # a third is chance
    search = GridSearchCV(fast.set_params(scale=16), {"photons": [0.2, 4]}, cv=2).fit(IMAGES, NAMES)
    assert search.best_params_ == {"photons": 4}
    again = copy.deepcopy(search.best_estimator_)  # through the bytes of its bundle, as in another process
    np.testing.assert_array_equal(again.predict(IMAGES), search.predict(IMAGES))
    assert again.bundle_.sha256 == search.best_estimator_.bundle_.sha256


def test_more_clicks_than_can_be_enumerated_are_sampled() -> None:
    given = FIXED | {"features": 21, "epochs": 1}
    found = PansClassifier(**given, scale=16).fit(IMAGES[:60], NAMES[:60]).measure(IMAGES[:60], NAMES[:60])
    assert found.trials == 30


@pytest.mark.parametrize(
    ("changed", "images", "words"),
    [
        ({}, IMAGES, "X reaches 16, scale is 1"),
        ({"scale": 16}, -IMAGES, "Negative values"),
        ({"scale": 0}, IMAGES, "scale is 0"),
        ({"scale": 16, "image_shape": (8, 9)}, IMAGES, "image_shape is"),
        ({"scale": 16, "shots": 2}, IMAGES, "shots is 2"),
    ],
)
def test_what_does_not_fit_is_refused(changed: dict[str, Any], images: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PansClassifier(**(SMALL | changed)).fit(images, NAMES)


@pytest.mark.parametrize(
    ("given", "remedy"),
    [
        ({"profile": "wdm-snspd", "features": 70}, "features=32, or fewer"),
        ({"features": 40, "options": {"states": 60_000}}, 'options={"states": '),
    ],
)
def test_a_remedy_names_the_keywords_of_the_call(given: dict[str, Any], remedy: str) -> None:
    with pytest.raises(PlanError) as found:
        PansClassifier(**(SMALL | {"scale": 16} | given)).fit(IMAGES[:30], DIGITS[:30])
    assert found.value.remedy.startswith(remedy)
    assert "--" not in str(found.value)


def test_classes_that_it_has_not_seen_are_refused(sensor: PansClassifier) -> None:
    with pytest.raises(ValueError, match="other classes"):
        sensor.measure(IMAGES[:1], ["three"])


@pytest.mark.slow
def test_with_light_enough_two_grey_values_are_told_apart() -> None:
    """The accuracy that scikit-learn asks of classifiers without the tag `poor_score`, on its own data."""
    from sklearn.datasets import make_blobs
    from sklearn.preprocessing import StandardScaler

    X, y = make_blobs(n_samples=300, random_state=0)
    X = StandardScaler().fit_transform(X)
    much = {"features": 2, "shots": 60, "photons": 1.5, "epochs": 100, "options": {"hidden": 32, "mix": 0.9}}
    assert PansClassifier(**(FIXED | much), scale="largest").fit(X - X.min(), y).score(X - X.min(), y) > 0.83


@pytest.mark.slow
def test_fixed_patterns_agree_with_a_plain_sum_over_words() -> None:
    sensor = PansClassifier(**(FIXED | {"features": 4, "epochs": 10}), scale=16).fit(IMAGES[:300], NAMES[:300])
    bundle, some = sensor.bundle_, np.rint(IMAGES[300:310] * (255 / 16)) / 255
    words = np.array([[word >> k & 1 for k in range(4)] for word in range(16)])
    labels = make_decider(bundle).decide_batch(words, 1)
    total = 0.0
    for seen, name in zip(some, NAMES[300:310]):
        p = 1 - np.exp(-(bundle.patterns() @ seen))
        chances = np.prod(np.where(words == 1, p, 1 - p), axis=1)
        total += chances[sensor.classes_[labels] == name].sum() / 10
    assert sensor.expected_score(IMAGES[300:310], NAMES[300:310]) == pytest.approx(total, abs=1e-9)
