"""Bundles: every byte counts, every inconsistency is named, golden vectors bind table and head; photon numbers in base `outcomes`."""

import hashlib
import os
import struct
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle, resealed
from heads import affine_head

from pans.base.errors import DamagedFileError, UsageError
from pans.bundle.sensor import Bundle, bundle_bytes, facts, parse_bundle
from pans.bundle.sensor import file_format as bundle_format
from pans.bundle.sensor.bundle import load_bundle, word_means, write_bundle


def random_head(d_f: int, classes: int, seed: int = 1) -> tuple[bytes, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    weights, bias = rng.normal(size=(d_f, classes)), rng.normal(size=classes)
    return affine_head(weights, bias), weights.astype(np.float32), bias.astype(np.float32)


def small_bundle(d_f: int = 2, **changes: Any) -> Bundle:
    facts: dict[str, Any] = {
        "name": "small",
        "classes": ("left", "right"),
        "image_shape": (1, 3),
        "levels": 4,
        "pattern_levels": np.arange(3 * d_f).reshape(d_f, 3) % 4,
        "photons_per_level": 0.25,
        "table": np.arange(2 << d_f, dtype=np.float32).reshape(-1, 2) % 5,
        "provenance": {"made_by": "test", "seed": 1, "loss": 0.1},
    }
    return made_bundle(**facts | changes)


def test_round_trip_keeps_every_fact(tmp_path: Path) -> None:
    made = small_bundle()
    digest = write_bundle(made, tmp_path / "a.pans")
    read, found = load_bundle(tmp_path / "a.pans")
    assert found == digest == hashlib.sha256((tmp_path / "a.pans").read_bytes()).hexdigest()
    for fact in ("name", "task", "classes", "encoder", "image_shape", "levels", "photons_per_level", "provenance"):
        assert getattr(read, fact) == getattr(made, fact)
    for array in ("pattern_levels", "table", "golden_means", "golden_scores"):
        wanted, got = getattr(made, array), getattr(read, array)
        assert got.dtype == wanted.dtype
        np.testing.assert_array_equal(got, wanted)
        assert not got.flags.writeable
    assert bundle_bytes(read) == bundle_bytes(made)
    assert os.listdir(tmp_path) == ["a.pans"]


def test_any_flipped_byte_any_truncation_and_any_rest_is_detected() -> None:
    data = bundle_bytes(small_bundle(d_f=1))
    parse_bundle(data, "whole")
    for position in range(len(data)):
        flipped = (data[:position] + bytes([data[position] ^ flip]) + data[position + 1 :] for flip in (1, 0x80, 0xFF))
        for changed in (data[:position], *flipped):
            with pytest.raises(DamagedFileError, match=r"^here: "):
                parse_bundle(changed, "here")
    for rest in (b"\0", b"x" * 40, data):
        with pytest.raises(DamagedFileError, match="too many"):
            parse_bundle(data + rest, "long")


@pytest.mark.parametrize("version", [0, 2, 0xFFFFFFFF])
def test_unknown_versions_are_refused_by_name(version: int) -> None:
    data = bundle_bytes(small_bundle())
    with pytest.raises(DamagedFileError, match=f"version {version}, allowed: 1"):
        parse_bundle(data[:8] + struct.pack("<I", version) + data[12:], "x")


def set_key(key: str, value: Any) -> Any:
    return lambda header: header.__setitem__(key, value)


def set_part(index: int, key: str, value: Any) -> Any:
    return lambda header: header["parts"][index].__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_key("classes", ["only"]), "1 classes"),
        (set_key("classes", ["same", "same"]), "same name"),
        (set_key("classes", ["a", "b\x1b[2J"]), "printable"),
        (set_key("classes", "ab"), "list of names"),
        (set_key("classes", ["a", "b", "c"]), "table has shape"),
        (set_key("levels", 1), "levels is 1"),
        (set_key("levels", 3), "pattern level is 3"),
        (set_key("levels", True), "levels is True"),
        (set_key("levels", 65537), "levels is 65537"),
        (set_key("photons_per_level", 0), "photons_per_level"),
        (set_key("photons_per_level", -1.0), "photons_per_level"),
        (set_key("photons_per_level", "0.1"), "photons_per_level"),
        (set_key("photons_per_level", float("nan")), "JSON"),
        (set_key("photons_per_level", 10**400), "header|too large|int"),
        (set_key("image_shape", [3, 3]), "3x3"),
        (set_key("image_shape", [-1, -3]), "image_shape"),
        (set_key("encoder", "tree"), "encoder is 'tree', allowed: active"),
        (set_key("encoder", ["active"]), "encoder"),
        (set_key("name", ""), "name is ''"),
        (set_key("provenance", [1]), "provenance"),
        (set_key("surplus", 1), "header has the keys"),
        (lambda header: header.pop("task"), "header has the keys"),
        (set_key("parts", []), "after the last part"),
        (lambda header: header["parts"].pop(1), "golden_means lies|outside|offset"),
        (set_part(0, "shape", [3, 2, 1]), "shape"),
        (set_part(0, "shape", [1 << 40, 1 << 40]), "shape"),
        (set_part(0, "shape", [-2, -3]), "shape"),
        (set_part(0, "shape", [1, 3]), "needs 6"),
        (set_part(0, "dtype", "|O"), "dtype"),
        (set_part(0, "name", "pickle"), "unknown part"),
        (set_part(1, "name", "pattern_levels"), "stands twice"),
        (set_part(1, "offset", 0), "outside the file or over"),
        (set_part(1, "sha256", "00" * 32), "does not have its SHA-256"),
        (set_part(0, "surplus", 1), "keys"),
    ],
)
def test_a_resealed_lie_is_named(change: Any, reason: str) -> None:
    with pytest.raises(DamagedFileError, match=reason):
        parse_bundle(resealed(bundle_bytes(small_bundle()), change), "x")


def test_a_table_that_contradicts_its_golden_vectors_is_refused() -> None:
    made = small_bundle()
    swapped = replace(made, table=made.table[::-1].copy())
    with pytest.raises(DamagedFileError, match="golden"):
        parse_bundle(bundle_bytes(swapped), "x")


def test_limits_come_before_allocation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = bundle_bytes(small_bundle())
    with pytest.raises(DamagedFileError, match="header of 4294967295 bytes"):
        parse_bundle(data[:12] + b"\xff\xff\xff\xff" + data[16:], "x")
    huge = tmp_path / "huge.pans"
    with open(huge, "wb") as file:
        file.truncate((256 << 20) + 1)  # sparse
    with pytest.raises(DamagedFileError, match="allowed at most"):
        load_bundle(huge)
    monkeypatch.setattr(bundle_format, "FILE_MAX_BYTES", 100)
    with pytest.raises(UsageError, match="allowed"):
        bundle_bytes(small_bundle())


HEADED = small_bundle(head_onnx=random_head(2, 2)[0], table=None)
BUDGETS = {  # of the format: a limit that a sound bundle is just beyond, and what is said of it
    ("FEATURES_MAX", 1): (HEADED, "2 patterns, allowed: 1 to 1"),
    ("PIXELS_MAX", 2): (HEADED, "3 pixels, allowed: 1 to 2"),
    ("CLASSES_MAX", 1): (HEADED, "2 classes, allowed: 2 to 1"),
    ("TABLE_ROWS_MAX", 2): (small_bundle(), "a table for 2 patterns, allowed at most 1"),
    ("HEAD_MAX_BYTES", 50): (HEADED, r"the head has \d+ bytes, allowed: 1 to 50"),
    ("GOLDEN_MAX", 3): (HEADED, r"\d+ golden vectors, allowed: 1 to 3"),
    ("GOLDEN_MEANS_MAX", 7): (HEADED, r"golden_means holds \d+ numbers, allowed at most 7"),
    ("GOLDEN_SCORES_MAX", 7): (HEADED, r"golden_scores holds \d+ numbers, allowed at most 7"),
    ("GOLDEN_WORK_MAX", 15): (HEADED, r"\d+ multiply-adds for the golden vectors, allowed: 15"),
}


@pytest.mark.parametrize(("name", "limit"), BUDGETS)
def test_what_is_beyond_a_budget_is_refused(name: str, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle, words = BUDGETS[name, limit]
    data = bundle_bytes(bundle)
    parse_bundle(data, "x")
    monkeypatch.setattr(facts, name, limit)
    with pytest.raises(DamagedFileError, match=words):
        parse_bundle(data, "x")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"table": None}, "neither"),
        ({"table": np.zeros((3, 2))}, "table has shape"),
        ({"table": np.full((4, 2), np.nan)}, "finite"),
        ({"pattern_levels": np.array([[0, 1, 4], [0, 0, 0]])}, "0 to 4|run from 0 to 4"),
        ({"pattern_levels": np.array([[0, 1, -1], [0, 0, 0]])}, "from -1"),
        ({"pattern_levels": np.zeros((2, 3))}, "integers"),
        ({"photons_per_level": float("inf")}, "photons_per_level"),
        ({"provenance": {"deep": [1, {"loss": float("nan")}]}}, r"deep\[1\]\.loss is nan"),
        ({"provenance": {"when": object()}}, "when is a object"),
        ({"provenance": {1: 2}}, "key 1"),
        ({"classes": ("a", "a")}, "same name"),
    ],
)
def test_what_cannot_be_made_is_refused_with_the_reason(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        small_bundle(**changes)


def test_a_failed_write_leaves_the_old_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.pans"
    write_bundle(small_bundle(), path)
    before = path.read_bytes()

    def full_disk(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(UsageError, match="No space"):
        write_bundle(small_bundle(d_f=1), path, force=True)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.pans"]


def test_missing_files_are_a_matter_of_usage(tmp_path: Path) -> None:
    for path, why in ((tmp_path / "none.pans", "there is no such bundle"), (tmp_path, "cannot be read")):
        with pytest.raises(UsageError, match=why):
            load_bundle(path)


def test_units_of_patterns_and_bit_i_of_a_word_is_pattern_i() -> None:
    made = small_bundle()
    np.testing.assert_array_equal(made.patterns(), [[0.0, 0.25, 0.5], [0.75, 0.0, 0.25]])
    assert made.illumination() == pytest.approx(1.75)
    assert (made.n_features, made.n_pixels, made.n_classes) == (2, 3, 2)
    np.testing.assert_array_equal(word_means([0b001, 0b110], 3), [[1, 0, 0], [0, 1, 1]])


def test_the_table_is_built_from_the_head() -> None:
    head, weights, bias = random_head(5, 3)
    made = small_bundle(d_f=5, table=None, head_onnx=head, classes=("a", "b", "c"))
    for word in range(32):
        means = [float(word >> i & 1) for i in range(5)]
        np.testing.assert_allclose(made.table[word], np.array(means) @ weights + bias, atol=1e-5)
    assert parse_bundle(bundle_bytes(made), "x").head_onnx == head
    fractions = made.golden_means[((made.golden_means > 0) & (made.golden_means < 1)).any(axis=1)]
    assert len(fractions) >= 8  # means over several shots are among the golden vectors


def test_head_and_table_must_agree_and_beyond_twelve_patterns_there_is_no_table() -> None:
    assert small_bundle(d_f=13, table=None, head_onnx=random_head(13, 2)[0]).table is None
    head, weights, bias = random_head(4, 2)
    table = word_means(np.arange(16), 4) @ weights + bias
    small_bundle(d_f=4, head_onnx=head, table=table)
    table[11, 1] += 1e-3
    with pytest.raises(UsageError, match="vector 11"):
        small_bundle(d_f=4, head_onnx=head, table=table)


OUTCOMES, D_F = 4, 3
WEIGHTS = np.random.default_rng(1).normal(size=(D_F, 2)).astype(np.float32)
BIAS = np.array([0.1, -0.2], np.float32)


def counted(**facts: Any) -> Any:
    return made_bundle(D_F, 2, **{"outcomes": OUTCOMES} | facts)


def test_a_head_gives_the_table_of_all_photon_numbers() -> None:
    made = counted(head_onnx=affine_head(WEIGHTS, BIAS))
    assert (made.largest, made.table.shape) == (3, (OUTCOMES**D_F, 2))
    for number, word in enumerate(product(range(OUTCOMES), repeat=D_F)):
        means = np.array(word[::-1]) / 3  # pattern 0 is the lowest digit
        assert made.table[number].tolist() == pytest.approx((means @ WEIGHTS + BIAS).tolist(), abs=1e-5)
        assert word_means([number], D_F, OUTCOMES)[0].tolist() == pytest.approx(means.tolist(), abs=1e-7)
    middle = (made.golden_means > 0) & (made.golden_means < 1)
    assert middle.any(axis=1).sum() > 60  # golden vectors are numbers, not clicks alone


def test_photon_numbers_are_read_back_whole() -> None:
    made = counted(table=np.random.default_rng(2).normal(size=(64, 2)))
    read = parse_bundle(bundle_bytes(made), "x")
    assert (read.outcomes, read.largest, read.n_features) == (4, 3, 3)
    assert np.array_equal(read.table, made.table)
    assert bundle_bytes(read) == bundle_bytes(made)
    assert made_bundle(D_F, 2, table=np.zeros((8, 2))).largest == 1


COUNTED = bundle_bytes(counted(table=np.arange(128.0).reshape(64, 2)))


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
        parse_bundle(resealed(COUNTED, lambda header: header.update(changes)), "x")


def test_what_makes_no_sense_is_not_made_and_a_large_table_is_not_looked_at() -> None:
    head = affine_head(WEIGHTS, BIAS)
    for wrong, words in (
        ({"outcomes": 17, "table": np.zeros((17**3, 2))}, "outcomes is 17, allowed"),
        ({"table": np.zeros((8, 2))}, "table has shape"),
        ({"table": np.zeros((64, 2)), "head_onnx": head}, "head and table disagree"),
        ({"head_onnx": head, "classes": [], "picture_shape": (1, 2)}, "4 outcomes per exposure"),
    ):
        with pytest.raises(UsageError, match=words):
            counted(**wrong)
    with pytest.raises(UsageError, match="a table for 6 patterns, allowed at most 5 of 16 readings each"):
        made_bundle(6, 2, outcomes=16, table=np.zeros((4, 2)))
