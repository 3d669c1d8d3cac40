"""Soft targets: what the network learns, that its answers repeat, and the file they are kept in."""

from dataclasses import replace

import numpy as np
import pytest
from trainings import bars_task

from pans.runtime.errors import DamagedFileError, UsageError
from pans.trainer.train.teacher import Taught, read_targets, soft_targets, write_targets

TAUGHT = Taught("0" * 64, 3, 2)
TARGETS = np.array([[0.5, 0.25, 0.25], [0, 1, 0], [0.2, 0.2, 0.6]], np.float32)


def test_the_network_knows_its_objects_as_probabilities():
    bars = bars_task(600).train
    answers = soft_targets(bars, 4, 12)
    assert answers.shape == (len(bars), 4)
    np.testing.assert_allclose(answers.sum(axis=1), 1.0, atol=1e-5)
    assert (answers.argmax(axis=1) == bars.labels).mean() > 0.9  # by chance 0.25
    assert 0.5 < answers.max(axis=1).mean() < 1.0


@pytest.mark.parametrize("other", [{"task": "1" * 64}, {"fitted": 4}, {"epochs": 3}])
def test_what_was_written_is_read_and_answers_of_other_objects_are_refused(tmp_path, other):
    path = tmp_path / "answers.npz"
    write_targets(path, TARGETS, TAUGHT)
    np.testing.assert_array_equal(read_targets(path, TAUGHT, 3), TARGETS)
    with pytest.raises(UsageError, match=r"answers\.npz holds Taught"):
        read_targets(path, replace(TAUGHT, **other), 3)


@pytest.mark.parametrize(
    "unfit",
    [TARGETS[:2], TARGETS[:, :2], TARGETS.astype(np.float64), TARGETS * 2, -TARGETS, TARGETS * np.nan],
    ids=["objects", "classes", "type", "sums", "negative", "nan"],
)
def test_unfit_targets_are_refused(tmp_path, unfit):
    path = tmp_path / "answers.npz"
    write_targets(path, unfit, TAUGHT)
    with pytest.raises(DamagedFileError, match="each row probabilities that sum to 1"):
        read_targets(path, TAUGHT, 3)
