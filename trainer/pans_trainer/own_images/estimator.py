"""A sensor with the interface of scikit-learn: `PansClassifier` trains patterns or an automaton on arrays, and decides on clicks.

Images and classes come in; decisions, posteriors and a bundle go out. All accuracies are SIMULATED through the profile.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from math import isqrt
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils import check_random_state
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, check_non_negative, validate_data

from pans.base.console import work_bar
from pans.base.errors import in_python_words
from pans.bundle.backends import make_decider
from pans.bundle.sensor import Bundle, bundle_bytes, load_bundle, parse_bundle, with_expected, write_bundle
from pans.instrument.profile import Profile, load_profile
from pans_trainer.baselines.common import Report, silent
from pans_trainer.device import one_thread
from pans_trainer.evaluate.accuracy import Measured, light_of
from pans_trainer.evaluate.held_out import HeldOut, as_trained, measure, trials_needed
from pans_trainer.evaluate.walks import MeasuredWalks, leaf_chances
from pans_trainer.export.automaton import export_automaton
from pans_trainer.export.writer import export_trained
from pans_trainer.options import EXACT_FEATURES_MAX, AutomatonOptions, Options, stated_tolerance
from pans_trainer.tasks.changes import Variation
from pans_trainer.tasks.registry import Objects, Task
from pans_trainer.train.automaton.train import train_automaton
from pans_trainer.train.gradient.loop import EpochReport, train

from .own import reporting
from .recipe import choose_encoder, choose_training

AUTOMATON = "automaton"
LARGEST = "largest"  # of `scale`
KEYWORDS = ("profile", "encoder", "features", "photons", "illumination", "epochs", "shots")  # others are `options`
GROW_EPOCHS = 4  # few images make few steps: 2 were worse on held-back digits
AT_ONCE = 256  # objects: the chances of all leaves stand in memory


class PansClassifier(ClassifierMixin, BaseEstimator):
    """A photon-counting sensor as a scikit-learn classifier: `fit` trains what light to send, `predict` decides on a few clicks.

    - `profile`: the instrument, a `Profile` or the name or path of one. Default: one without faults.
    - `encoder`: "automaton" (each pattern follows from the clicks before it), "active" (fixed patterns), or "incoherent" and "coherent"
      for passive optics. None: an automaton where the profile can show one.
    - `features`: number of patterns; of an automaton the most exposures of a decision. None: 10, or 32 of an automaton.
    - `photons`, `illumination`: what a decision may take on average, photoelectrons detected and photoelectrons sent (those that a clear
      pixel would give, summed over pixels and patterns). Without both: 10 photons.
    - `epochs`: passes over the training images. None: 6 of an automaton, else about 3000 steps.
    - `shots`: exposures of every pattern (not of an automaton).
    - `scale`: the value in X that stands for full transmission (1); 0 is black. A brighter pixel is a ValueError. "largest": the largest
      value in the X of `fit`, and a brighter pixel counts as that.
    - `image_shape`: height and width, where X is flat. None: a square where there is one, else a row.
    - `options`: further fields of `pans_trainer.options.Options` (of an automaton: `AutomatonOptions`), such as {"states": 64}.
    - `random_state`: seed of the training and of the clicks, as everywhere in scikit-learn.
    - `verbose`: 1 displays a bar while `fit` trains, on a terminal or in a notebook.

    `predict` and `predict_proba` draw clicks. A fitted sensor draws the same ones for the same image, so that two calls agree and neither
    the order of the images nor the batch matters. An image that X holds several times has other clicks each time: to see the noise,
    repeat it. `expected_score` has no noise. Images are rounded to 256 grey levels, as those of any task.

    Attributes: `classes_`, `n_features_in_`, `image_shape_`, `bundle_` (runs as it is: `pans.run(sensor.bundle_, "sim:ideal")`),
    `profile_`. Labels of the bundle are places in `classes_`.

    >>> from sklearn.datasets import load_digits
    >>> images, digits = load_digits(n_class=2, return_X_y=True)
    >>> sensor = PansClassifier(features=6, photons=5, scale=16, random_state=0).fit(images[:200], digits[:200])
    >>> found = sensor.measure(images[200:], digits[200:])
    >>> bool(found.accuracy_mean > 0.9), round(found.photons_mean), found.clicks_mean < found.photons_mean < found.illumination
    (True, 5, True)
    """

    bundle_: Bundle
    classes_: NDArray[Any]
    n_features_in_: int

    def __init__(
        self,
        profile: Profile | str | Path = "ideal",
        *,
        encoder: str | None = None,
        features: int | None = None,
        photons: float | None = None,
        illumination: float | None = None,
        epochs: int | None = None,
        shots: int = 1,
        scale: float | str = 1.0,
        image_shape: tuple[int, int] | None = None,
        options: Mapping[str, Any] | None = None,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        self.profile, self.encoder, self.features = profile, encoder, features
        self.photons, self.illumination, self.epochs, self.shots = photons, illumination, epochs, shots
        self.scale, self.image_shape, self.options, self.random_state = scale, image_shape, options, random_state
        self.verbose = verbose

    # ---- what scikit-learn asks for ----

    @in_python_words(KEYWORDS)
    @one_thread()
    def fit(self, X: ArrayLike, y: ArrayLike) -> PansClassifier:
        """Train on images `X`, (n, pixels) or (n, height, width), of the classes `y`, (n,).

        ValueError for pixels outside 0 to `scale`; UsageError or PlanError for what the profile or the training cannot do.
        """
        given, shape = _flat(X)
        grey, named = validate_data(self, given, y, dtype=(np.float64, np.float32))
        check_classification_targets(named)
        self.classes_, labels = np.unique(named, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"y holds one class, {self.classes_[0]}, needed are 2 or more")
        self.image_shape_ = _image_shape(self.image_shape or shape, grey.shape[1])
        self.scale_ = float(grey.max()) or 1.0 if self.scale == LARGEST else float(self.scale)
        self.seed_ = int(check_random_state(self.random_state).randint(1 << 31))
        self.profile_ = self.profile if isinstance(self.profile, Profile) else load_profile(self.profile)
        every = self._objects(grey, labels)
        objects = every.take(np.random.default_rng(self.seed_).permutation(len(every)))  # the last ones are held back
        digest = hashlib.sha256(objects.images.tobytes() + objects.labels.tobytes()).hexdigest()
        names = tuple(str(name) for name in self.classes_)
        task = Task("arrays", names, objects, objects, digest, "none held out", source="arrays given to PansClassifier")
        with TemporaryDirectory() as folder, work_bar() if self.verbose else nullcontext(silent) as report:
            self.bundle_ = self._trained(task, Path(folder) / "sensor.pans", report)
        return self

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the class decided for every image, (n,), each on clicks drawn for it."""
        chosen = self.predict_proba(X).argmax(axis=1)
        return self.classes_[chosen]

    @one_thread()
    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return the posterior of every class, float64 (n, classes), given the clicks that `predict` decides on."""
        objects = self._asked(X)
        if self.bundle_.automaton is not None:
            return self._at_leaves(objects.images)
        how = as_trained(self.bundle_)
        optics: dict[str, Any] = {"imaging": how.imaging_on(self.profile_), "bleaching": how.bleaching}
        light = light_of(self.bundle_, self.profile_, objects.images, **optics)
        draws = enumerate(self._draws(objects.images))
        counts = np.concatenate([light.counts(self.shots, draw, slice(at, at + 1)) for at, draw in draws])
        scores = make_decider(self.bundle_, shots=self.shots).scores_batch(counts, self.shots).astype(np.float64)
        chances = np.exp(scores - scores.max(axis=1, keepdims=True))
        return np.asarray(chances / chances.sum(axis=1, keepdims=True))

    def expected_score(self, X: ArrayLike, y: ArrayLike) -> float:
        """Return the accuracy that `score` has on average over all clicks that may come: `measure(X, y).accuracy_mean`."""
        return float(self.measure(X, y).accuracy_mean or 0.0)

    @one_thread()
    def measure(self, X: ArrayLike, y: ArrayLike) -> Measured | MeasuredWalks:
        """Return accuracy, clicks, photons and illumination per decision on images `X` of the classes `y`, with their errors.

        Exact expectations over the clicks; where these cannot be enumerated (more than 20 patterns), of 30 decisions per image.
        ValueError for a class that `fit` has not seen.
        """
        objects = self._asked(X)
        wanted = np.asarray(y)
        labels = np.minimum(np.searchsorted(self.classes_, wanted), len(self.classes_) - 1)
        if wanted.shape != objects.labels.shape or not np.array_equal(self.classes_[labels], wanted):
            raise ValueError(f"y {wanted.shape} holds other classes than {self.classes_}, or not one for each image")
        task = Task("arrays", self.bundle_.classes, objects, Objects(objects.images, labels), "", "")
        held_out = HeldOut(task, task.test, self.profile_)
        trials, how = trials_needed(self.bundle_, self.shots), as_trained(self.bundle_)
        found = measure(self.bundle_, held_out, shots=self.shots, trials=trials, conditions=how)
        assert isinstance(found, Measured | MeasuredWalks), "a classifier returns no pictures"
        return found

    @in_python_words()
    def save(
        self, path: str | Path, X: ArrayLike | None = None, y: ArrayLike | None = None, *, force: bool = False
    ) -> str:
        """Write the bundle to `path` (.pans) and return its SHA-256; UsageError if it exists, unless `force`.

        A run of an automaton compares its accuracy with what the bundle states: on images `X` of the classes `y` that `fit` has not seen,
        without them on the training images, which is too high. UsageError with images for fixed patterns, which state nothing.
        """
        check_is_fitted(self)
        bundle = self.bundle_
        if X is not None:
            found = self.measure(X, () if y is None else y)
            names = ("accuracy", "clicks", "photons", "exposures")
            told = {name: getattr(found, f"{name}_mean", 0.0) for name in names}
            told |= {"illumination": found.illumination, "objects": found.objects, "split": "held-out images"}
            told["first_state_clicked"] = getattr(found, "first_state_clicked", None)
            bundle = with_expected(bundle, {**(bundle.expected or {}), **told})
        return write_bundle(bundle, path, force=force)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.positive_only = tags.input_tags.three_d_array = True
        tags.classifier_tags.poor_score = True  # of two grey values ten photons do not tell what a number does
        return tags

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process needs: the bundle as bytes, which are checked when they are read."""
        state = dict(super().__getstate__())
        if "bundle_" in state:
            state["_bundle"] = bundle_bytes(state.pop("bundle_"))
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        held = state.pop("_bundle", None)
        super().__setstate__(state)
        if held is not None:
            self.bundle_ = parse_bundle(held, "the bundle of a PansClassifier")

    # ---- between arrays and the trainer ----

    def _asked(self, X: ArrayLike) -> Objects:
        """Checked images to decide on; their labels stand for nothing."""
        check_is_fitted(self)
        grey = validate_data(self, _flat(X)[0], dtype=(np.float64, np.float32), reset=False)
        return self._objects(grey, np.zeros(len(grey), np.int64))

    def _objects(self, X: NDArray[Any], labels: NDArray[np.int64]) -> Objects:
        check_non_negative(X, type(self).__name__)
        if self.scale != LARGEST and (not self.scale_ > 0 or X.max() > self.scale_):
            raise ValueError(
                f"X reaches {X.max():g}, scale is {self.scale_:g}, allowed: pixels from 0 (black) to scale (full transmission); "
                f'give scale=255 for 8-bit images, say, or scale="{LARGEST}"'
            )
        grey = np.rint(np.minimum(X / self.scale_, 1.0) * 255).astype(np.uint8)
        return Objects(grey.reshape(len(X), *self.image_shape_), labels.astype(np.int64))

    def _trained(self, task: Task, path: Path, report: Report) -> Bundle:
        """Train and export, with what `pans train` chooses for own images where nothing is asked for."""
        encoder = self.encoder or choose_encoder(self.profile_)[0]
        if encoder == AUTOMATON and self.shots != 1:
            raise ValueError(f"shots is {self.shots}, allowed with an automaton: 1")
        recipe = choose_training(task, Variation(), encoder)
        photons = recipe.photons if self.photons is None and self.illumination is None else self.photons
        given: dict[str, Any] = {"photons": photons, "illumination": self.illumination, "seed": self.seed_}
        given |= {"epochs": self.epochs or recipe.epochs, "batch": recipe.batch}
        given["optics"] = stated_tolerance(self.profile_) if encoder in ("active", AUTOMATON) else None
        about: dict[str, Any] = {"name": "sensor", "provenance": {"options": {}}}
        if encoder == AUTOMATON:
            sizes = {"exposures": self.features or recipe.exposures, "states": recipe.states, "copies": 0, "soft": 0.0}
            sizes["grow_epochs"] = GROW_EPOCHS
            wanted = AutomatonOptions(**(given | sizes | dict(self.options or {})))
            grown = train_automaton(task, self.profile_, wanted, report=reporting(report))
            bundle = export_automaton(path, grown, task, self.profile_, **about).bundle
            expected = {**(bundle.expected or {}), "split": "the training images"}  # none were held out
            write_bundle(with_expected(bundle, expected), path, force=True)
            return load_bundle(path)[0]
        features = self.features or recipe.features
        given |= {"features": features, "encoder": encoder, "shots": self.shots, "conserving": encoder != "active"}
        given["estimator"] = "exact" if features <= EXACT_FEATURES_MAX else "local"
        asked = Options(**(given | dict(self.options or {})))

        def tell(epoch: EpochReport) -> None:
            done = (epoch.restart * asked.epochs + epoch.epoch) / (asked.epochs * asked.restarts)
            report(f"epoch {epoch.epoch} of {asked.epochs}, loss {epoch.loss:.3f}", done)

        trained = train(task, self.profile_, asked, report=tell)
        return export_trained(path, trained, task, self.profile_, **about).bundle

    def _draws(self, images: NDArray[np.uint8]) -> Iterator[np.random.Generator]:
        """Random numbers for each image, which depend on the image and on how often it came before, not on the others."""
        before: Counter[bytes] = Counter()
        for image in images:
            digest = hashlib.sha256(image.tobytes()).digest()
            yield np.random.default_rng([self.seed_, int.from_bytes(digest[:8]), before[digest]])
            before[digest] += 1

    def _at_leaves(self, images: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Posteriors at the leaves at which walks end: a leaf drawn with its chance is that of a walk with clicks drawn."""
        automaton = self.bundle_.automaton
        assert automaton is not None
        uniform = np.array([draw.random() for draw in self._draws(images)])
        leaves = np.empty(len(images), np.int64)
        for start in range(0, len(images), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            chances = leaf_chances(self.bundle_, self.profile_, images[part], as_trained(self.bundle_))
            upto = chances.cumsum(axis=1)
            leaves[part] = (upto < uniform[part, None] * upto[:, -1:]).sum(axis=1)
        return automaton.posteriors[automaton.n_states + leaves].astype(np.float64)


def _flat(X: ArrayLike) -> tuple[Any, tuple[int, int] | None]:
    """`X` with flat images, and their height and width where it says so."""
    if getattr(X, "ndim", 0) != 3:
        return X, None
    images = np.asarray(X)
    return images.reshape(len(images), -1), (int(images.shape[1]), int(images.shape[2]))


def _image_shape(asked: tuple[int, int] | None, pixels: int) -> tuple[int, int]:
    """Height and width of images of so many pixels; ValueError where those that are asked for have others."""
    side = isqrt(pixels)
    height, width = asked or ((side, side) if side * side == pixels else (1, pixels))
    if height * width != pixels:
        raise ValueError(
            f"image_shape is {height, width}, allowed for {pixels} pixels per image: a product of {pixels}"
        )
    return int(height), int(width)
