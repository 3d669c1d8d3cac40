"""Bundles of fixed patterns that take photon numbers: the table in base `outcomes`, and what is refused."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle, resealed
from heads import affine_head

from pans.runtime.bundle.model import bundle_bytes, parse_bundle, word_means
from pans.runtime.errors import DamagedFileError, UsageError

OUTCOMES, D_F = 4, 3
WEIGHTS = np.random.default_rng(1).normal(size=(D_F, 2)).astype(np.float32)
BIAS = np.array([0.1, -0.2], np.float32)


def counted(**facts: Any) -> Any:
    return made_bundle(D_F, 2, **{"outcomes": OUTCOMES} | facts)


def test_a_head_gives_the_table_of_all_numbers() -> None:
    made = counted(head_onnx=affine_head(WEIGHTS, BIAS))
    assert (made.largest, made.table.shape) == (3, (OUTCOMES**D_F, 2))
    for number, word in enumerate(product(range(OUTCOMES), repeat=D_F)):
        means = np.array(word[::-1]) / 3  # pattern 0 is the lowest digit
        assert made.table[number].tolist() == pytest.approx((means @ WEIGHTS + BIAS).tolist(), abs=1e-5)
        assert word_means([number], D_F, OUTCOMES)[0].tolist() == pytest.approx(means.tolist(), abs=1e-7)
    middle = (made.golden_means > 0) & (made.golden_means < 1)
    assert middle.any(axis=1).sum() > 60  # golden vectors are numbers, not clicks alone


def test_they_are_read_back_whole() -> None:
    made = counted(table=np.random.default_rng(2).normal(size=(64, 2)))
    read = parse_bundle(bundle_bytes(made), "x")
    assert (read.outcomes, read.largest, read.n_features) == (4, 3, 3)
    assert np.array_equal(read.table, made.table)
    assert bundle_bytes(read) == bundle_bytes(made)
    assert made_bundle(D_F, 2, table=np.zeros((8, 2))).largest == 1


FILE = bundle_bytes(counted(table=np.arange(128.0).reshape(64, 2)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"outcomes": 2}, "outcomes is 2, allowed: a whole number from 3 to 16"),
        ({"outcomes": 17}, "outcomes is 17, allowed"),
        ({"outcomes": True}, "outcomes is True, allowed"),
        ({"outcomes": 4.0}, "outcomes is 4.0, allowed"),
        ({"outcomes": 5}, r"table has shape \(64, 2\), allowed: \(5\*\*d_f, classes\) = \(125, 2\)"),
        ({"picture_shape": [1, 1]}, "a picture and 2 classes"),
        ({"expected": {}}, "header has the keys"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(DamagedFileError, match=words):
        parse_bundle(resealed(FILE, lambda header: header.update(changes)), "x")


def test_what_makes_no_sense_is_not_made_and_a_large_table_is_not_looked_at() -> None:
    head = affine_head(WEIGHTS, BIAS)
    for facts, words in (
        ({"outcomes": 17, "table": np.zeros((17**3, 2))}, "outcomes is 17, allowed"),
        ({"table": np.zeros((8, 2))}, "table has shape"),
        ({"table": np.zeros((64, 2)), "head_onnx": head}, "head and table disagree"),
        ({"head_onnx": head, "classes": [], "picture_shape": (1, 2)}, "4 outcomes per exposure"),
    ):
        with pytest.raises(UsageError, match=words):
            counted(**facts)
    with pytest.raises(UsageError, match="a table for 6 patterns, allowed at most 5 of 16 readings each"):
        made_bundle(6, 2, outcomes=16, table=np.zeros((4, 2)))
