"""Numbers of options, sizes of arrays and kinds of files: what makes no sense is refused with what is allowed, in no time."""

import io
import json
import os
import struct
import zipfile
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from pans.app.main import main
from pans.base.errors import ConfigError, DamagedFileError, UsageError
from pans.base.files.container import open_regular, parse_json_object
from pans.base.files.npz import read_arrays
from pans.base.numbers.ranges import FINITE, WHOLE, Range
from pans.record.replay import _images
from pans.report.files.verify import verify_file
from pans_sim.scene.still import load_scene


def test_ranges() -> None:
    assert Range(0, 1).checked(1, "x") == 1
    wrong = (Range(0, 1), True), (Range(0, 1), "1"), (WHOLE, 1.0), (WHOLE, 1 << 63), (FINITE, float("nan"))
    for allowed, value in wrong:
        with pytest.raises(ValueError, match=r"x is .*allowed: a"):
            allowed.checked(value, "x")
    with pytest.raises(ValueError, match=r"^x is 1979-05-27, allowed: a number"):  # as TOML has dates
        FINITE.checked(date(1979, 5, 27), "x")


NOT_JSON = [
    *('{"a":1e999}', '{"a":18446744073709551616}', '{"a":-1e309}', '{"a":NaN}', '{"a":1,"a":1}', "[1]"),
    *('{"a":' + "[" * depth + "]" * depth + "}" for depth in (64, 80)),
]


@pytest.mark.parametrize("text", NOT_JSON, ids=lambda text: text[:30])
def test_json_is_strict(text: str) -> None:
    with pytest.raises(DamagedFileError, match=r"^x: "):
        parse_json_object(text.encode(), "x")


@pytest.mark.parametrize("text", ['{"a":18446744073709551615}', '{"a":1e308}', '{"a":' + "[" * 63 + "]" * 63 + "}"])
def test_json_up_to_its_limits_is_read(text: str) -> None:
    assert parse_json_object(text.encode(), "x") == json.loads(text)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.pans"
    os.mkfifo(pipe)
    kinds = {pipe: "pipe", tmp_path: "folder", Path("/dev/zero"): "device", tmp_path / "none": "No such file"}
    for path, kind in kinds.items():
        with pytest.raises(UsageError, match=kind):
            open_regular(path)
    with pytest.raises(UsageError, match="pipe"):
        verify_file(pipe)
    assert main([*("run", str(pipe)), "--device", "sim:ideal", "--decisions", "1"]) == 2
    assert main(["replay", str(pipe)]) == 2


def claiming(shape: str, descr: str = "|u1") -> bytes:
    """A .npz of a few bytes whose array claims to be of `shape`, word for word."""
    end = ", }" if shape.endswith(")") else ""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}{end}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("images.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    return file.getvalue()


TOO_LARGE = ("(100, 28, 28000000)", f"({1 << 40}, 28, 28)", "(0, 9223372036854775807, 9223372036854775807)")
NO_SHAPE = ("(-1, 28, 28)", "(0, 28, 28)", "(5,4,4", "(" * 3000, "(True,4,4)", "(5.0,4,4)", "()")


@pytest.mark.parametrize("shape", [*TOO_LARGE, *NO_SHAPE], ids=lambda shape: shape[:20])
def test_a_small_file_cannot_ask_for_much(shape: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    path.write_bytes(claiming(shape))
    with pytest.raises(UsageError, match=r"truth\.npz"):
        _images(path)
    with pytest.raises(ConfigError, match=r"truth\.npz"):
        load_scene(path)


def test_good_arrays_are_read(tmp_path: Path) -> None:
    images = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    np.savez_compressed(tmp_path / "a.npz", images=images, labels=np.array([0, 1]))
    assert (_images(tmp_path / "a.npz") == images).all()
    assert set(read_arrays(tmp_path / "a.npz", ("images", "labels", "more"), 1 << 20)) == {"images", "labels"}
    with pytest.raises(ValueError, match="allowed are 10"):
        read_arrays(tmp_path / "a.npz", ("images",), 10)


def test_an_archive_that_unpacks_to_far_more_than_itself_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", images=np.zeros((65, 1024, 1024), np.uint8))  # 65 MiB in 70 kB
    with pytest.raises(ValueError, match=r"unpacks to 65 MiB of arrays.*allowed are 64 MiB; numpy\.savez"):
        read_arrays(tmp_path / "a.npz", None, 1 << 30)
    np.savez(tmp_path / "a.npz", images=np.zeros((65, 1024, 1024), np.uint8))
    assert read_arrays(tmp_path / "a.npz", None, 1 << 30)["images"].nbytes == 65 << 20


def test_texts_of_no_characters_are_refused(tmp_path: Path) -> None:
    """numpy reads such an array, and Python cannot make a text of it."""
    for dtype in ("<U2", ">U2"):
        names = np.array(["ab", "c"], dtype)
        np.savez(tmp_path / "a.npz", classes=names, images=np.zeros((2, 2, 2), np.uint8))
        assert read_arrays(tmp_path / "a.npz", ["classes"], 1 << 20)["classes"].tolist() == ["ab", "c"]
        names.view(f"{dtype[0]}u4")[0] = 0x7FFFFFFF
        np.savez(tmp_path / "a.npz", classes=names, images=np.zeros((2, 2, 2), np.uint8))
        with pytest.raises(ValueError, match=r"classes holds the character 2147483647, allowed: 0 to 1114111"):
            read_arrays(tmp_path / "a.npz", ["classes"], 1 << 20)


@pytest.mark.parametrize("name", ["x.pans", "x.pansrec", "x"])
def test_foreign_bytes_are_named_as_numbers(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / name).write_bytes(b"PANSX\x05\x00\xff" + bytes(64))
    assert main(["verify", str(tmp_path / name)]) == 2
    said = "".join(capsys.readouterr())
    assert "it starts with the bytes 50 41 4e 53 58 05 00 ff" in said
    assert "b'" not in said
