"""The barcode task is exact: all strings, their labels, the priors, and samples that follow them."""

from fractions import Fraction

import numpy as np
import pytest

from pans.trainer.tasks import barcode as task_barcode


def test_all_strings_and_labels_against_python_strings():
    bars, labels = task_barcode.all_strings()
    for i in (0, 1, 10, 341, 682, 1023, *range(100, 160)):
        text = f"{i:010b}"
        assert "".join(map(str, bars[i])) == text
        assert labels[i] == ("1010" in text)
    assert labels.sum() == sum("1010" in f"{i:010b}" for i in range(1024)) == 357
    assert task_barcode.occurrences(bars)[0b1010101010] == 4


@pytest.mark.parametrize("prior", task_barcode.PRIORS)
def test_priors_are_distributions(prior):
    weights, (_, labels) = task_barcode.weights(prior), task_barcode.all_strings()
    assert weights.sum() == pytest.approx(1)
    positive = weights[labels == 1].sum()
    assert positive == pytest.approx(357 / 1024 if prior == "uniform" else 0.5)


def test_inserted_is_a_uniform_string_written_over_at_a_uniform_place():
    exact = [Fraction(0)] * 1024
    for place in range(7):
        for rest in range(64):
            left, right = f"{rest:06b}"[:place], f"{rest:06b}"[place:]
            exact[int(left + "1010" + right, 2)] += Fraction(1, 7 * 64)
    weights, (_, labels) = task_barcode.weights("inserted"), task_barcode.all_strings()
    assert np.where(labels == 1, weights, 0) == pytest.approx([float(p) / 2 for p in exact])


@pytest.mark.parametrize("prior", task_barcode.PRIORS)
def test_samples_follow_the_prior(prior):
    images, labels = task_barcode.draw(3, "train", 60_000, prior)
    assert images.shape == (60_000, 1, 10)
    assert set(np.unique(images)) == {0, 255}
    index = ((images[:, 0] > 0) * (1 << np.arange(9, -1, -1))).sum(axis=1)
    assert np.array_equal(labels, task_barcode.all_strings()[1][index])
    wanted = task_barcode.weights(prior) * 60_000
    chi2 = ((np.bincount(index, minlength=1024) - wanted) ** 2 / wanted).sum()
    assert abs(chi2 - 1023) < 5 * np.sqrt(2 * 1023)


def test_the_number_of_bright_bars_tells_nothing_under_the_uniform_prior():
    bars, labels = task_barcode.all_strings()
    best = {}
    for prior in task_barcode.PRIORS:
        joint = np.zeros((11, 2))
        np.add.at(joint, (bars.sum(axis=1), labels), task_barcode.weights(prior))
        best[prior] = joint.max(axis=1).sum()
    assert best["uniform"] == pytest.approx(667 / 1024)  # what the prior alone gives
    assert best["balanced"] == pytest.approx(0.5747, abs=1e-3)
    assert best["inserted"] == pytest.approx(0.5885, abs=1e-3)


def test_an_unknown_prior_or_part_is_refused():
    with pytest.raises(ValueError, match="prior 'even'"):
        task_barcode.weights("even")
    with pytest.raises(ValueError, match="part 'valid'"):
        task_barcode.draw(0, "valid", 1)
