"""Numbers of options, sizes of arrays and kinds of files: what makes no sense is refused with what is allowed, in no time."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pans.firmware_sim.scene.still import load_scene
from pans.runtime.cli import main
from pans.runtime.container import open_regular, parse_json_object
from pans.runtime.errors import ConfigError, DamagedFileError, UsageError
from pans.runtime.npz_file import read_arrays
from pans.runtime.ranges import FINITE, WHOLE, Range
from pans.runtime.record.pictures import _images
from pans.runtime.report.verify import verify_file

RUN = ["run", "none.pans", "--device", "sim:ideal"]


@pytest.mark.parametrize("text", [str(1 << 64), "nan", "-1", "1e3", "", "9" * 5000], ids=lambda text: text[:30])
def test_options_are_refused_with_what_is_allowed(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*RUN, "--decisions", text])
    assert ended.value.code == 2
    assert "argument --decisions" in (told := capsys.readouterr().err)
    assert " from " in told.split("is not a")[1]


@pytest.mark.parametrize("command", [["evaluate", "x.pans", "--eta", "nan"], ["calibrate", "--seconds", "inf"]])
def test_every_command_refuses_what_is_no_number(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(command)
    assert f"{command[-1]!r} is not a number from" in capsys.readouterr().err


def test_ranges() -> None:
    assert Range(0, 1).checked(1, "x") == 1
    for allowed, value in (
        (Range(0, 1), True),
        (Range(0, 1), "1"),
        (WHOLE, 1.0),
        (WHOLE, 1 << 63),
        (FINITE, float("nan")),
    ):
        with pytest.raises(ValueError, match=r"x is .*allowed: a"):
            allowed.checked(value, "x")


@pytest.mark.parametrize(
    "text", ['{"a":1e999}', '{"a":18446744073709551616}', '{"a":-1e309}', '{"a":' + "[" * 80 + "]" * 80 + "}"]
)
def test_json_numbers_stay_in_range(text: str) -> None:
    with pytest.raises(DamagedFileError, match=r"beyond|deep"):
        parse_json_object(text.encode(), "x")


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.pans"
    os.mkfifo(pipe)
    for path, kind in (
        (pipe, "pipe"),
        (tmp_path, "folder"),
        (Path("/dev/zero"), "device"),
        (tmp_path / "none", "No such file"),
    ):
        with pytest.raises(UsageError, match=kind):
            open_regular(path)
    with pytest.raises(UsageError, match="pipe"):
        verify_file(pipe)
    assert main([*("run", str(pipe)), "--device", "sim:ideal", "--decisions", "1"]) == 2
    assert main(["replay", str(pipe)]) == 2


def claiming(shape: tuple[int, ...], name: str = "images") -> bytes:
    """A .npz of a few bytes whose array claims to be of `shape`."""
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    return file.getvalue()


@pytest.mark.parametrize("shape", [(100, 28, 28_000_000), (1 << 40, 28, 28), (-1, 28, 28), (0, 28, 28)])
def test_a_small_file_cannot_ask_for_much(shape: tuple[int, ...], tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    path.write_bytes(claiming(shape))
    with pytest.raises(UsageError, match=r"claims|images are|allowed"):
        _images(path)
    with pytest.raises(ConfigError, match=r"claims|must be|allowed"):
        load_scene(path)


def test_good_arrays_are_read(tmp_path: Path) -> None:
    images = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    np.savez_compressed(tmp_path / "a.npz", images=images, labels=np.array([0, 1]))
    assert (_images(tmp_path / "a.npz") == images).all()
    assert set(read_arrays(tmp_path / "a.npz", ("images", "labels", "more"), 1 << 20)) == {"images", "labels"}
    with pytest.raises(ValueError, match="allowed are 10"):
        read_arrays(tmp_path / "a.npz", ("images",), 10)
