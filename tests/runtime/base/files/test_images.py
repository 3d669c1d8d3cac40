"""A user's pictures: every pixel format keeps its grey levels, and what cannot be kept is refused."""

import struct

import numpy as np
import pytest

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import images
from pans.base.files.images import Reading, read_class_folder, read_grey
from pans_trainer.tasks.registry import load_task

Image = pytest.importorskip("PIL.Image")
RAMP = np.tile(np.arange(0, 256, 17, dtype=np.uint8), (4, 1))
RAMP_16 = RAMP.astype(np.uint16) * 257


PIXELS = {
    **{"8.png": RAMP, "8.tiff": RAMP, "16.png": RAMP_16, "16.tiff": RAMP_16, "32.tiff": RAMP_16.astype(np.int32)},
    **{"float.tiff": (RAMP / 255).astype(np.float32), "rgb.png": np.dstack([RAMP] * 3)},
    "rgba.png": np.dstack([RAMP, RAMP, RAMP, np.full_like(RAMP, 255)]),
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


def test_what_is_transparent_becomes_black(tmp_path):
    Image.fromarray(np.dstack([RAMP, RAMP, RAMP, 255 - RAMP])).save(tmp_path / "a.png")
    wanted = RAMP.astype(float) * (255.0 - RAMP) / 255
    assert np.abs(read_grey(tmp_path / "a.png", 1000) - wanted).max() < 1


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_their_exif_data_say(tmp_path, orientation):
    """What a viewer shows, by the standard's table: which edge of the picture rows and columns begin at."""
    rng = np.random.default_rng(0)
    seen = np.kron(rng.integers(0, 256, (3, 4)), np.ones((16, 16))).astype(np.uint8)
    turned = {
        1: seen,
        2: seen[:, ::-1],
        3: seen[::-1, ::-1],
        4: seen[::-1],
        5: seen.T,
        6: seen.T[::-1],
        7: seen.T[::-1, ::-1],
        8: seen.T[:, ::-1],
    }
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(turned[orientation]).save(tmp_path / "a.png", exif=exif)
    assert np.array_equal(read_grey(tmp_path / "a.png", 10_000), seen)


def folder_of(path, **classes):
    for name, pictures in classes.items():
        (path / name).mkdir(parents=True)
        for file, picture in pictures.items():
            Image.fromarray(picture).save(path / name / file)
    return path


def test_photos_of_any_size_become_means_over_areas(tmp_path):
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (120, 160), dtype=np.uint8)
    deep = (rng.random((60, 80)) * 6000).astype(np.uint16)  # dim: on 8 bits before the mean few levels would be left
    wide = rng.integers(0, 256, (96, 144), dtype=np.uint8)
    small = np.full((6, 8), 77, np.uint8)
    folder_of(tmp_path / "set", a={"0.png": grey, "1.tif": deep}, b={"0.png": wide, "1.png": small})
    found = read_class_folder(tmp_path / "set", 10_000, Reading(side=16))
    assert found.images.shape == (4, 12, 16)  # 11.65 rows: the aspect ratio is the mean one, by its logarithm

    def means(picture, rows, columns):  # of whole blocks
        h, w = picture.shape
        return picture.reshape(rows, h // rows, columns, w // columns).mean(axis=(1, 3))

    assert np.abs(found.images[0] - means(grey, 12, 16)).max() <= 1
    assert np.abs(found.images[1] - means(deep, 12, 16) / 257).max() <= 0.51
    assert np.abs(found.images[2] - means(wide[:, 8:136], 12, 16)).max() <= 1  # its middle
    assert (found.images[3] == 77).all()
    assert found.account.classes["a"] == {"files": 2, "taken": 2, "resized": 2}
    told = "\n".join(found.account.lines())
    for words in (
        "16 x 12 pixels (--resize 16)",
        "8 x 6 to 160 x 120",
        "1 of 16 bits",
        "1 enlarged",
        "1 cut at the edges",
        "11% of the area",
    ):
        assert words in told, words
    padded = read_class_folder(tmp_path / "set", 10_000, Reading(side=16, pad=True)).images[2]
    assert not padded[-1].any()
    assert padded[:-1].all()


def test_small_pictures_of_one_size_stay_as_they_are(tmp_path):
    rng = np.random.default_rng(2)
    pictures = {f"{i}.png": rng.integers(0, 256, (40, 64), dtype=np.uint8) for i in range(2)}
    folder_of(tmp_path, a=pictures)
    assert np.array_equal(read_class_folder(tmp_path, 10_000, Reading()).images, list(pictures.values()))
    Image.fromarray(rng.integers(0, 256, (80, 128), dtype=np.uint8)).save(tmp_path / "a" / "2.png")
    assert read_class_folder(tmp_path, 10_000, Reading()).images.shape == (3, 20, 32)


def test_bad_files_and_duplicates_are_named_and_passed_over_only_if_asked(tmp_path, monkeypatch):
    rng = np.random.default_rng(3)
    first, second, third, huge = (rng.integers(0, 256, (30 + i, 30), dtype=np.uint8) for i in range(4))
    folder_of(
        tmp_path,
        a={"0.png": first, "1.png": second, "2.tif": first},
        b={"0.png": second, "1.png": third, "2.png": huge},
    )
    (tmp_path / "b" / "notes.txt").write_text("not a picture")
    monkeypatch.setattr(images, "PICTURE_PIXELS_MAX", 32 * 30)
    with pytest.raises(UsageError, match="notes") as caught:
        read_class_folder(tmp_path, 10_000, Reading(side=8))
    assert "more than the 960 allowed" in caught.value.message
    assert "of another class" in caught.value.message
    assert "--skip-bad" in caught.value.remedy
    found = read_class_folder(tmp_path, 10_000, Reading(side=8, skip_bad=True))
    assert found.labels.tolist() == [0, 1]  # `second` stands in both classes: in which one is right, nobody can tell
    assert found.account.duplicates == {"a/2.tif": "a/0.png"}
    assert set(found.account.refused) == {"a/1.png", "b/0.png", "b/2.png", "b/notes.txt"}
    assert found.account.classes["b"] == {"files": 4, "taken": 1, "resized": 1, "refused": 3}
    with pytest.raises(UsageError, match="a folder within"):  # the folder itself is wrong: that is no bad file
        (tmp_path / "b" / "more").mkdir()
        read_class_folder(tmp_path, 10_000, Reading(side=8, skip_bad=True))


def test_a_folder_passes_over_hidden_names(tmp_path):
    for name in ("cat", "dog", ".trash"):
        (tmp_path / name).mkdir()
        for i in range(6):
            Image.fromarray(RAMP_16 + np.uint16(257 * (6 * (name == "dog") + i)) * (RAMP_16 == 0)).save(
                tmp_path / name / f"{i}.png"
            )
    (tmp_path / "cat" / ".DS_Store").write_bytes(b"x")
    task = load_task(str(tmp_path))
    assert task.classes == ("cat", "dog")
    assert len(task.everything()) == 12
    assert np.array_equal(task.train.images[0][:, 1:], RAMP[:, 1:])


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


def test_formats_that_are_not_listed_are_not_opened_whatever_they_are_called(tmp_path):
    picture = Image.fromarray(np.dstack([RAMP] * 3))
    for form in ("EPS", "DDS", "ICO"):  # the first starts Ghostscript
        picture.save(tmp_path / "a.png", form)
        with pytest.raises(DamagedFileError, match=r"a\.png: not a picture, or cut; allowed: BMP, GIF, JPEG, PNG"):
            read_grey(tmp_path / "a.png", 1000)


def test_whatever_a_decoder_raises_is_a_damaged_picture(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.tiff")
    whole = (tmp_path / "a.tiff").read_bytes()
    for place in range(len(whole)):
        for byte in (0, 255):
            (tmp_path / "a.tiff").write_bytes(whole[:place] + bytes([byte]) + whole[place + 1 :])
            try:
                assert read_grey(tmp_path / "a.tiff", 1000).ndim == 2
            except (DamagedFileError, UsageError) as error:
                assert "a.tiff: " in error.message  # noqa: PT017


LARGE = {
    "f.tiff": ("F", {"compression": "tiff_deflate"}),
    "rgb.png": ("RGB", {}),
    "rgba.webp": ("RGBA", {}),
    "progressive.jpg": ("RGB", {"progressive": True}),
}


@pytest.mark.parametrize("name", LARGE)
def test_a_picture_that_takes_too_much_memory_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, name):
    mode, way = LARGE[name]
    Image.new(mode, (200, 100)).save(tmp_path / name, **way)
    read_grey(tmp_path / name, 20_000)
    monkeypatch.setattr(images, "PICTURE_BYTES_MAX", 200 * 100 * 5 - 1)
    monkeypatch.setattr(Image.Image, "load", lambda picture: pytest.fail("unpacked"))
    with pytest.raises(UsageError, match=r"200 x 100 pixels, of .* allowed: 0"):
        read_grey(tmp_path / name, 20_000)


def test_tiles_larger_than_their_picture_are_counted(tmp_path):
    sizes = {256: 16, 257: 4, 322: 1 << 15, 323: 1 << 15}  # of the picture, and of a tile: 1 GiB of 8 bits
    rows = sorted((sizes | {258: 8, 259: 8, 262: 1, 277: 1, 324: 8, 325: 100}).items())
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in rows)
    (tmp_path / "a.tiff").write_bytes(struct.pack("<2sHIH", b"II", 42, 8, len(rows)) + entries + bytes(4))
    with pytest.raises(UsageError, match=r"take 1024 MiB, allowed: 256"):
        read_grey(tmp_path / "a.tiff", 1000)


def test_no_message_names_an_open_file_by_its_address(tmp_path):
    (tmp_path / "a.png").write_bytes(images.PNG_END * 9)
    for read in (lambda: read_grey(tmp_path / "a.png", 10), lambda: images.read_grey_png(images.PNG_END * 9, "a.png")):
        with pytest.raises(DamagedFileError) as caught:
            read()
        assert "_io." not in str(caught.value)
