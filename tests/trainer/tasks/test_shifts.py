"""Training images out of place: moved by whole pixels, reproducibly, with nothing wrapped round."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from pans.trainer.tasks.changes import shifted
from pans.trainer.tasks.registry import Objects


def objects(n: int) -> Objects:
    images = np.zeros((n, 9, 11), np.uint8)
    images[:, 4, 5] = 200
    return Objects(images, np.arange(n))


def test_no_shift_is_the_same_objects() -> None:
    some = objects(3)
    assert shifted(some, 0, 0, 1) is some


def test_shifts_are_uniform_and_reproducible() -> None:
    moved = shifted(objects(4000), 3, 1, 5)
    np.testing.assert_array_equal(moved.images, shifted(objects(4000), 3, 1, 5).images)
    _, y, x = np.nonzero(moved.images)
    assert len(y) == 4000
    for found, most in ((x - 5, 3), (y - 4, 1)):
        counts = np.bincount(found + most, minlength=2 * most + 1)
        expected = 4000 / (2 * most + 1)
        assert len(counts) == 2 * most + 1
        assert abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_what_moves_out_is_lost_and_what_moves_in_is_black() -> None:
    full = Objects(np.full((200, 9, 11), 7, np.uint8), np.zeros(200, np.int64))
    moved = shifted(full, 20, 0, 2).images
    lost = 11 - (moved == 7).all(axis=1).sum(axis=1)
    assert {0, 11} <= set(lost.tolist())
    for image, gone in zip(moved, lost):
        columns = image[0] == 7
        assert columns[: 11 - gone].all() or columns[gone:].all()
        assert image.sum() == 7 * 9 * (11 - gone)
