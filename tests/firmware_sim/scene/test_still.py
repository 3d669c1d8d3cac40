"""Scenes: targets, files, and everything that a file may get wrong."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.base.errors import ConfigError
from pans_sim.scene import still as scene_module
from pans_sim.scene.still import load_scene, shipped_scenes

IMAGES = np.arange(3 * 4 * 5, dtype=np.uint8).reshape(3, 4, 5)


def saved(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_a_file_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    path = saved(tmp_path / "bags.npz", images=IMAGES, labels=np.array([1, 0, -1]), classes=np.array(["bag", "boot"]))
    scene = load_scene(path)
    assert scene.name == "bags"
    assert np.array_equal(scene.images, IMAGES)
    assert scene.labels.dtype == np.int16
    assert scene.labels.tolist() == [1, 0, -1]
    assert scene.classes == ("bag", "boot")
    assert (scene.n_objects, scene.n_pixels, scene.any_shape, scene.lit) == (3, 20, False, True)
    assert [scene.truth(index) for index in range(5)] == [1, 0, -1, 1, 0]
    assert not scene.images.flags.writeable


def test_targets_fit_any_shape() -> None:
    uniform, dark = load_scene("uniform"), load_scene("dark")
    assert uniform.any_shape
    assert uniform.lit
    assert dark.any_shape
    assert not dark.lit
    assert uniform.truth(7) == -1
    assert {"uniform", "dark"} <= set(shipped_scenes())


def test_every_shipped_scene_loads() -> None:
    for name in shipped_scenes():
        scene = load_scene(name)
        assert scene.name == name
        assert scene.n_objects >= 1


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"pictures": IMAGES}, "no array `images`"),
        ({"images": IMAGES.astype(np.float32)}, "must be uint8"),
        ({"images": IMAGES[0]}, "objects, height, width"),
        ({"images": IMAGES[:0]}, "not empty"),
        ({"images": IMAGES, "labels": np.zeros(2, np.int16)}, "one for each image"),
        ({"images": IMAGES, "labels": np.zeros(3)}, "must be integers"),
        ({"images": IMAGES, "labels": np.array([0, 1, 2]), "classes": np.array(["a", "b"])}, r"-1..1, found 0..2"),
        ({"images": IMAGES, "labels": np.array([0, -2, 1])}, "found -2..1"),
        ({"images": IMAGES, "classes": np.array([1, 2])}, "list of at most"),
        ({"images": np.array([None, 1], dtype=object)}, "images claims|not a readable"),
    ],
)
def test_a_wrong_array_is_named(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = saved(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(ConfigError, match=message) as caught:
        load_scene(path)
    assert "wrong.npz" in str(caught.value)


def test_an_unknown_name_lists_the_shipped_scenes() -> None:
    with pytest.raises(ConfigError, match=r"neither a shipped scene nor a file(.|\n)*uniform"):
        load_scene("nowhere")


@pytest.mark.parametrize("keep", [0, 10, 60, -30])
def test_a_cut_file_is_refused(tmp_path: Path, keep: int) -> None:
    whole = saved(tmp_path / "whole.npz", images=IMAGES).read_bytes()
    cut = tmp_path / "cut.npz"
    cut.write_bytes(whole[:keep])
    with pytest.raises(ConfigError, match="not a readable scene"):
        load_scene(cut)


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = saved(tmp_path / "flip.npz", images=IMAGES)
    data = bytearray(path.read_bytes())
    position = data.index(IMAGES.tobytes()) + 7
    data[position] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(ConfigError, match="not a readable scene"):
        load_scene(path)


def test_a_header_that_claims_too_much_allocates_nothing(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (100_000, 4096, 4096)}
    )
    path = tmp_path / "liar.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("images.npy", header.getvalue() + b"\0" * 100)
    with pytest.raises(ConfigError, match="images claims 1677721600000 bytes"):
        load_scene(path)


def test_sizes_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path / "big.npz", images=IMAGES)
    monkeypatch.setattr(scene_module, "MAX_OBJECTS", 2)
    with pytest.raises(ConfigError, match="at most 2 objects"):
        load_scene(path)
    monkeypatch.setattr(scene_module, "MAX_SCENE_BYTES", 100)
    with pytest.raises(ConfigError, match="allowed are 100"):
        load_scene(path)
