"""The barcode task is exact: all strings, their labels, the priors, and samples that follow them."""

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
