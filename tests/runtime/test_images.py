"""A user's pictures: every pixel format keeps its grey levels, and what cannot be kept is refused."""

import numpy as np
import pytest

from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.images import read_class_folder, read_grey
from pans.trainer.tasks.registry import load_task

Image = pytest.importorskip("PIL.Image")
RAMP = np.tile(np.arange(0, 256, 17, dtype=np.uint8), (4, 1))
RAMP_16 = RAMP.astype(np.uint16) * 257


PIXELS = {
    **{"8.png": RAMP, "8.tiff": RAMP, "16.png": RAMP_16, "16.tiff": RAMP_16, "32.tiff": RAMP_16.astype(np.int32)},
    **{"float.tiff": (RAMP / 255).astype(np.float32), "rgb.png": np.dstack([RAMP] * 3)},
    "rgba.png": np.dstack([RAMP, RAMP, RAMP, 255 - RAMP]),
}


@pytest.mark.parametrize("name", PIXELS)
def test_grey_levels_are_kept(tmp_path, name):
    Image.fromarray(PIXELS[name]).save(tmp_path / name)
    found = read_grey(tmp_path / name, 1000)
    assert found.dtype == np.uint8
    assert np.array_equal(found, RAMP)


def test_colours_become_luminance(tmp_path):
    colours = np.zeros((1, 3, 3), np.uint8)
    colours[0, [0, 1, 2], [0, 1, 2]] = 255
    Image.fromarray(colours).save(tmp_path / "a.png")
    assert read_grey(tmp_path / "a.png", 10).tolist() == [[76, 150, 29]]  # 0.299, 0.587, 0.114 of 255


@pytest.mark.parametrize("value", [1.5, -0.1, np.nan])
def test_values_beyond_full_scale_are_refused(tmp_path, value):
    Image.fromarray(np.array([[0.0, value]], np.float32)).save(tmp_path / "a.tiff")
    with pytest.raises(UsageError, match=r"a\.tiff: values"):
        read_grey(tmp_path / "a.tiff", 10)


def test_frames_size_and_damage_are_refused(tmp_path):
    picture = Image.fromarray(RAMP)
    picture.save(tmp_path / "stack.tiff", save_all=True, append_images=[picture])
    picture.save(tmp_path / "a.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:45])
    with pytest.raises(UsageError, match="2 frames"):
        read_grey(tmp_path / "stack.tiff", 1000)
    with pytest.raises(UsageError, match="more than the 63"):
        read_grey(tmp_path / "a.png", 63)
    with pytest.raises(DamagedFileError, match=r"cut\.png"):
        read_grey(tmp_path / "cut.png", 1000)


def test_a_folder_passes_over_hidden_names(tmp_path):
    for name in ("cat", "dog", ".trash"):
        (tmp_path / name).mkdir()
        for i in range(6):
            Image.fromarray(RAMP_16).save(tmp_path / name / f"{i}.png")
    (tmp_path / "cat" / ".DS_Store").write_bytes(b"x")
    task = load_task(str(tmp_path))
    assert task.classes == ("cat", "dog")
    assert len(task.everything()) == 12
    assert np.array_equal(task.train.images[0], RAMP)


def test_all_faults_of_a_folder_are_listed_at_once(tmp_path):
    for name in ("cats", "dogs", "empty"):
        (tmp_path / name).mkdir()
    picture = Image.fromarray(RAMP)
    for name in ("cats/a.png", "cats/b.png", "dogs/a.png", "stray.png"):
        picture.save(tmp_path / name)
    Image.fromarray(RAMP[:, :3]).save(tmp_path / "dogs/small.png")
    (tmp_path / "dogs/notes.txt").write_text("not a picture")
    (tmp_path / "cats/more").mkdir()
    (tmp_path / "empty/.DS_Store").write_bytes(b"litter")
    with pytest.raises(UsageError) as caught:
        read_class_folder(tmp_path, 10_000)
    lines = caught.value.message.split("\n")
    assert lines[0] == f"{tmp_path}: 5 faults"
    faults = {
        "stray.png": "beside",
        "more": "within",
        "small.png": f"3 x {len(RAMP)}",
        "notes.txt": "",
        "empty": "without pictures",
    }
    for name, why in faults.items():
        assert any(name in line and why in line for line in lines[1:]), name
    assert caught.value.remedy
