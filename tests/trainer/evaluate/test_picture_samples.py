"""Samples of pictures given back: whose they are, and that they are kept as they were."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from pans.trainer.evaluate.picture_samples import (  # noqa: E402
    PARTS,
    first_of_each_class,
    keep_samples,
    read_samples,
    take_samples,
)
from pans.trainer.model.heads import MlpHead  # noqa: E402
from pans.trainer.tasks.registry import Objects  # noqa: E402

D_F = 5
SIDE = 6


def objects() -> Objects:
    rng = np.random.default_rng(3)
    shown, behind = (rng.integers(0, 256, (9, SIDE, SIDE), dtype=np.uint8) for _ in range(2))
    return Objects(shown, np.array([2, 0, 2, 1, 0, 1, 1, 0, 2]), behind)


def head() -> MlpHead:
    made = MlpHead(D_F, 7, SIDE * SIDE, torch.Generator().manual_seed(0))
    return made.eval()


def test_the_first_object_of_every_class_with_what_lies_behind_it():
    chosen, every = first_of_each_class(objects()), objects()
    assert chosen.labels.tolist() == [0, 1, 2]
    assert np.array_equal(chosen.images, every.images[[1, 3, 0]])
    assert np.array_equal(chosen.pictures, every.behind[[1, 3, 0]])


def test_samples_are_of_single_shots_and_the_same_again():
    p = torch.full((3, D_F), 0.5, dtype=torch.float64)
    first, again = (take_samples(head(), p, first_of_each_class(objects())) for _ in range(2))
    assert np.array_equal(first.given_back, again.given_back)
    assert len({picture.tobytes() for picture in first.given_back.reshape(-1, SIDE * SIDE)}) > 2


def test_they_are_read_as_they_were_kept(tmp_path):
    samples = take_samples(head(), torch.full((3, D_F), 0.4, dtype=torch.float64), first_of_each_class(objects()))
    keep_samples(tmp_path / "a.npz", samples)
    found = read_samples(tmp_path / "a.npz")
    for part in PARTS:
        assert np.array_equal(getattr(found, part), getattr(samples, part))
        assert getattr(found, part).dtype == getattr(samples, part).dtype
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
