"""Draws docs/pictures/refit.png: accuracy after `pans refit` by the number of labelled objects, image off by (1, 1) px. SIMULATED.

PANS_DATA=folder python docs/pictures/refit.py       (extras `train` and `plot`; about two minutes)

Clicks are drawn from the exact probabilities of the Fashion-MNIST test images, moved one pixel right and down; half of the images
are for fitting, the other half judges, exactly. The limit is the posterior of the first 10 000 training images, moved likewise.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot

from pans.bundle.automaton import log_scores
from pans.bundle.backends import expected_walk
from pans.bundle.sensor import load_bundle, word_means
from pans.calibrate.refit import choose, evidence_of, kinds_for, log_softmax
from pans.instrument.click_law import object_transmission
from pans.instrument.detector import afterpulses_of
from pans.instrument.profile import load_profile
from pans_trainer.evaluate.accuracy import exposure_of, light_of, outcome_law_of
from pans_trainer.tasks import load_task

SIZES, DRAWS = (100, 200, 500, 1000, 2000, 4000), 10


def moved(images):
    """The images one pixel to the right and down."""
    found = np.zeros_like(images)
    found[:, 1:, 1:] = images[:, :-1, :-1]
    return found


def outcomes(bundle, profile, images):
    """The chance of each row (click word or leaf) for each image."""
    if bundle.automaton is None:
        clicks = light_of(bundle, profile, images).probability
        chance = np.ones((len(images), 1))
        for column in clicks.T[:, :, None]:
            chance = np.concatenate([chance * (1 - column), chance * column], axis=1)
        return chance
    law, parts = outcome_law_of(bundle, profile, 1.0, None), []
    for start in range(0, len(images), 1000):
        seen = object_transmission(profile, images[start : start + 1000].reshape(-1, bundle.n_pixels))
        walk = expected_walk(
            bundle.automaton,
            bundle.pattern_levels,
            seen,
            law,
            bundle.photons_per_level,
            afterpulses=afterpulses_of(profile, exposure_of(bundle, profile)),
        )
        parts.append(walk.leaves)
    chance = np.concatenate(parts)
    return chance / chance.sum(axis=1, keepdims=True)


def refitted(scores, means, chance, labels, objects: int, seed: int) -> tuple[float, float]:
    """Accuracy of the old and of the refitted scores on the half that is not fitted."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(labels))
    fit, judge = order[:objects], order[len(labels) // 2 :]
    row = (chance[fit].cumsum(axis=1) < rng.random(objects)[:, None]).sum(axis=1)
    number, seen = np.unique(row, return_inverse=True)
    evidence = evidence_of(scores[number], means[number], seen, labels[fit], np.arange(objects))
    found = choose(evidence, kinds_for(evidence, rows=not means.shape[1]))
    centred = scores - scores.mean(axis=1, keepdims=True)
    new = centred if found.correction is None else found.correction.apply(centred, means)
    new[number] = found.scores
    return accuracy(scores, chance[judge], labels[judge]), accuracy(new, chance[judge], labels[judge])


def accuracy(scores, chance, labels) -> float:
    """The exact share of right decisions."""
    return float((chance * (log_softmax(scores).argmax(axis=1) == labels[:, None])).sum() / len(labels))


def main() -> None:
    """Draw one panel for each shipped bundle."""
    task = load_task("fashion-mnist")
    train, train_labels = task.train.images[:10_000], task.train.labels[:10_000]
    test, labels = task.test.images, task.test.labels
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, name in zip(axes, ("fashion10", "fashion-adaptive")):
        bundle, _ = load_bundle(name)
        profile = load_profile(str(bundle.provenance["profile"]))
        if bundle.automaton is None:
            scores, means = bundle.table.astype(float), word_means(np.arange(len(bundle.table)), 10).astype(float)
        else:
            scores = log_scores(bundle.automaton.posteriors[bundle.automaton.n_states :]).astype(float)
            means = np.zeros((len(scores), 0))
        chance = outcomes(bundle, profile, moved(test))
        known = outcomes(bundle, profile, moved(train))
        limit = np.stack([known[train_labels == c].mean(axis=0) for c in range(10)], axis=1) + 1e-9
        rows = np.array([[refitted(scores, means, chance, labels, n, seed) for seed in range(DRAWS)] for n in SIZES])
        print(name, SIZES, "old", rows[:, :, 0].mean(axis=1), "new", rows[:, :, 1].mean(axis=1))
        print("  standard deviation over draws", rows[:, :, 1].std(axis=1, ddof=1))
        new = 100 * rows[:, :, 1]
        label = "refitted (10 draws, standard deviation)"
        axis.errorbar(SIZES, new.mean(axis=1), new.std(axis=1, ddof=1), fmt="o-", capsize=3, label=label)
        nominal = accuracy(scores, outcomes(bundle, profile, test), labels)
        for value, text, style in (
            (nominal, "nothing shifted", "k-"),
            (accuracy(np.log(limit), chance, labels), "limit of any refit: exact posteriors", "k--"),
            (accuracy(scores, chance, labels), "old back end", "k:"),
        ):
            print("  ", text, value)
            axis.axhline(100 * value, ls=style[1:], color="k", lw=1, label=text)
        axis.set(
            xscale="log", xlabel="labelled objects", ylabel="accuracy / %", title=f"{name}, image off by (1, 1) px"
        )
        axis.set_xticks(SIZES, [str(size) for size in SIZES])
        axis.minorticks_off()
        axis.legend(fontsize=8, loc="center right", bbox_to_anchor=(1.0, 0.74))
    figure.suptitle("SIMULATED: pans refit on Fashion-MNIST", fontsize=10)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
