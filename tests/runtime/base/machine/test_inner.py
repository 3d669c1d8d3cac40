"""Bytes as numbers in kernels, and kernels that kernels alone call."""

from __future__ import annotations

import importlib.util
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit
from tree import FOLDERS, ROOT

from pans.base.machine import jit as wire_inner
from pans.base.machine.jit import OTHERS, SOURCES, TRIED, digest_of, inner, kernel_folder
from pans.base.machine.jit_bytes import as_float32, copy_span, load4, load8

U = np.uint64


@inner
def _tripled(x):  # type: ignore[no-untyped-def]
    return 3 * x


@njit(nogil=True)
def _through(data, source, out):  # type: ignore[no-untyped-def]
    """Numbers of `data` to `out`, and three bytes of `data` moved by one within it, and four of `source` behind them."""
    out[0], out[1] = load8(data, U(1)), load4(data, U(2))
    out[2] = _tripled(out[1])
    copy_span(data, U(3), U(6), data, U(4))
    copy_span(source, U(1), U(5), data, U(7))
    copy_span(source, U(1), U(1), data, U(0))
    return as_float32(U(0x1_3F800000))


@pytest.mark.uncompiled
def test_bytes_are_numbers_and_are_copied() -> None:
    rng = np.random.default_rng(5)
    data, source = rng.integers(0, 256, (2, 11)).astype(np.uint8)
    before, out = bytes(data), np.zeros(3, np.uint64)
    one = _through(data, source, out)
    four = int.from_bytes(before[2:6], "little")
    assert out.tolist() == [int.from_bytes(before[1:9], "little"), four, 3 * four]
    assert bytes(data) == before[:4] + before[3:6] + bytes(source[1:5])
    assert one == 1.0


@pytest.mark.skipif(numba.version_info.short not in TRIED, reason="compiled as all others with this version of numba")
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without the compiler it is Python's")
def test_an_inner_kernel_is_not_called_from_python() -> None:
    with pytest.raises(TypeError):
        _tripled(2)


KERNEL = """
from pans.base.machine import outer

@outer
def doubled(x):
    return 2 * x
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache of kernels."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    kernel_folder.cache_clear()
    yield tmp_path / "cache"
    kernel_folder.cache_clear()


def hits_of(file: Path) -> int:
    """Load the kernel of `file` as one of pans; how often it came from the cache."""
    kernel_folder.cache_clear()
    spec = importlib.util.spec_from_file_location("pans.made", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.doubled(4) == 8
    return sum(module.doubled.stats.cache_hits.values())


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is cached")
def test_a_kernel_is_compiled_once_for_all_places_of_the_same_sources(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first" / "made.py", tmp_path / "second" / "made.py"
    for seconds, file in enumerate((first, second)):
        file.parent.mkdir()
        file.write_text(KERNEL)
        os.utime(file, (seconds, seconds))
    found = [hits_of(first), hits_of(first), hits_of(second)]
    with monkeypatch.context() as changed:
        changed.setattr(wire_inner, "digest_of", lambda top, packages: "changed")
        found += [hits_of(first), hits_of(second)]
    assert [*found, hits_of(first)] == [0, 1, 1, 0, 1, 1]
    assert [path.stat().st_mode & 0o777 for path in cache.iterdir()] == [0o700, 0o700]


def test_the_digest_is_of_what_the_files_hold(tmp_path: Path) -> None:
    for package in SOURCES:
        (tmp_path / package).mkdir(parents=True)
        (tmp_path / package / "kernels.py").write_text("x = 1")
    first, last = (tmp_path / package for package in (SOURCES[0], SOURCES[-1]))
    changes: list[Callable[[], object]] = [
        lambda: (last / "kernels.py").write_text("x = 2"),
        lambda: (first / "more.py").touch(),
        lambda: os.utime(first / "kernels.py", ns=(1, 1)),
        lambda: (first / "notes.txt").touch(),
    ]
    digests = [digest_of.__wrapped__(tmp_path, SOURCES)]
    for change in changes:
        change()
        digests.append(digest_of.__wrapped__(tmp_path, SOURCES))
    assert (len(set(digests)), len(set(digests[2:]))) == (3, 1)


@pytest.mark.parametrize("how", ["writable", "link", "owner", "file"])
def test_what_others_may_have_put_there_is_not_run(
    how: str, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    usual = kernel_folder()
    usual.rmdir()
    if how == "owner" and os.geteuid() != 0:
        pytest.skip("a folder is given away by root alone")
    made = {"link": lambda: usual.symlink_to(tmp_path), "file": usual.touch}.get(how, usual.mkdir)
    made()
    if how == "writable":
        usual.chmod(0o770)
    if how == "owner":
        os.chown(usual, 12345, -1)
    kernel_folder.cache_clear()
    found = kernel_folder()
    assert found.parent == Path(tempfile.gettempdir())
    assert found.stat().st_mode & 0o777 == 0o700
    said = capsys.readouterr().err
    assert "compiled at each start" in said
    assert str(usual) in said


def test_old_folders_go_when_a_new_one_comes(cache: Path) -> None:
    kernel_folder().rmdir()
    for age_h in range(8):
        for name in (f"pans-kernels-0.1.0-{age_h:016x}", f"pans-kernels-of-mine-{age_h}"):
            (cache / name).mkdir()
            os.utime(cache / name, (time.time() - 3600 * age_h + 60,) * 2)
    kernel_folder.cache_clear()
    kept = {f"pans-kernels-0.1.0-{age_h:016x}" for age_h in range(4)} | {kernel_folder().name}
    assert {path.name for path in cache.glob("pans-kernels-0*")} == kept
    assert len(list(cache.glob("pans-kernels-of-mine-*"))) == 8


def test_every_kernel_that_is_kept_is_kept_there() -> None:
    files = [file for top in OTHERS for file in (ROOT / FOLDERS[top]).rglob("*.py") if "cache=True" in file.read_text()]
    kept = [file.name for file in files if re.search(r"from pans\.base\.machine import .*\bnjit\b", file.read_text())]
    assert sorted(kept) == sorted(file.name for file in files if file.name != "jit.py") != []


def test_with_another_numba_kernels_are_ordinary_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire_inner, "TRIED", ())
    kernels = [decorate(lambda x: 3 * x) for decorate in (wire_inner.inner, wire_inner.outer)]
    assert [kernel(2) for kernel in kernels] == [6, 6]


def test_the_numba_that_is_installed_with_the_package_was_tried() -> None:
    (pinned,) = re.findall(r"^numba==(\d+)\.(\d+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert tuple(map(int, pinned)) in TRIED
    (least,) = re.findall(r'"numba>=(\d+)\.(\d+)"', (ROOT / "pyproject.toml").read_text())
    assert tuple(map(int, least)) <= min(TRIED)
