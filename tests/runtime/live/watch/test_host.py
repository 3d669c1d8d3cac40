"""The computer around a run: how long a disk lasts, clocks that are set, and a run that stops before its disk is full."""

from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import Pans

from pans.app.main import main
from pans.bundle.sensor.bundle import write_bundle
from pans.live.options import RunOptions
from pans.live.watch import host
from pans.live.watch.host import DiskTrend, HostWatch
from pans.record.reading import read_recording
from pans_sim.testing import small_setup

Usage = namedtuple("Usage", "total used free")
MIB = 1 << 20


def test_time_left_at_the_present_rate() -> None:
    trend = DiskTrend()
    for second in range(0, 300, 5):
        assert trend.left_s(second, 10**9 - 10**6 * second) is None  # too short to tell
    assert trend.left_s(300.0, 10**9 - 300 * 10**6) == pytest.approx(700)
    for second in range(305, 350, 5):  # something was deleted, and nobody writes
        assert trend.left_s(second, 2 * 10**9) is None


def test_the_rate_is_that_of_the_last_ten_minutes() -> None:
    trend = DiskTrend()
    free = 10**12
    for second in range(0, 2400, 5):
        free -= 5 * (10**6 if second < 1200 else 10**3)
        left_s = trend.left_s(second, free)
    assert left_s == pytest.approx(free / 10**3, rel=1e-6)


def test_a_clock_that_is_set_is_a_step_and_one_that_is_slewed_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    offsets = [10**18 + 2_500_000 * step for step in range(100)]  # 500 ppm
    offsets += [offsets[-1] - 3_600_000_000_000, offsets[-1]]
    left = iter([offsets[0], *offsets])
    monkeypatch.setattr(host, "clock_offset_ns", lambda: next(left))
    watch = HostWatch(None, 0, list[str]().append)
    watch.close()
    for _ in offsets[1:]:
        watch.look()
    assert [one["step_s"] for one in watch.news] == [-3600.0, 3600.0]
    assert watch.facts["host_clock_steps"] == 2


def watch_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: list[int], reserve: int
) -> tuple[HostWatch, list[str]]:
    """A watch whose thread never looks, on a disk with these bytes free at each look."""
    left, asked = iter(free), list[str]()
    monkeypatch.setattr(host.shutil, "disk_usage", lambda path: Usage(0, 0, next(left)))
    recorder: Any = SimpleNamespace(open_file=SimpleNamespace(path=tmp_path / "run.pansrec", is_deleted=False))
    watch = HostWatch(recorder, reserve, asked.append)
    for _ in free[1:]:
        watch.look()
    watch.close()
    return watch, asked


def test_short_space_is_told_once_and_too_little_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.pansrec").write_bytes(bytes(7))
    free = [600 * MIB, 499 * MIB, 480 * MIB, 700 * MIB, 400 * MIB, 99 * MIB, 50 * MIB]
    watch, asked = watch_of(tmp_path, monkeypatch, free, 100 * MIB)
    told = [(one["kind"], one["free_bytes"] // MIB) for one in watch.news]
    assert told == [("disk_short", 499), ("disk_short", 400), ("disk_nearly_full", 99)]
    assert asked == [host.DISK_NEARLY_FULL]
    assert (watch.facts["disk_free_bytes"], watch.facts["recording_bytes"]) == (50 * MIB, 7)


def test_without_a_reserve_nothing_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watch, asked = watch_of(tmp_path, monkeypatch, [3, 2, 1, 0], 0)
    assert (asked, list(watch.news)) == ([], [])


def test_parts_are_deleted_before_a_run_is_stopped() -> None:
    assert RunOptions(disk_reserve_mb=64).stop_below == 64 * MIB
    assert RunOptions(rotate_mb=10, disk_reserve_mb=64).stop_below == 5 * MIB  # the keeper deletes below 20
    assert RunOptions(rotate_mb=10, disk_reserve_mb=0).stop_below == 0


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    write_bundle(small_setup("sequential")[1], tmp_path / "grid.pans")
    device = "sim:ideal?scene=uniform&seed=3&pace=fast"
    return ["run", str(tmp_path / "grid.pans"), "--device", device, "--out", str(tmp_path / "out"), "--json"]


def test_a_run_stops_in_order_before_its_disk_is_full(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans
) -> None:
    recorded = tmp_path / "out" / "run.pansrec"

    def usage(path: Path) -> Usage:
        return Usage(0, 0, 63 * MIB if recorded.exists() and recorded.stat().st_size > 50_000 else 10**12)

    monkeypatch.setattr(host.shutil, "disk_usage", usage)
    monkeypatch.setattr(host, "EVERY_S", 0.1)
    summary = pans(*words[:-1], "--seconds", "100000", code=1)
    assert (summary["ended"], summary["verdict"]) == (host.DISK_NEARLY_FULL, "FAIL")
    assert host.DISK_NEARLY_FULL in summary["faults"]
    recording = read_recording(recorded)
    assert recording.complete
    assert recording.n_decisions == summary["decisions"] > 0
    assert [event["kind"] for event in recording.events()].count("disk_nearly_full") == 1


def test_a_run_does_not_begin_on_a_disk_that_is_nearly_full(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans
) -> None:
    monkeypatch.setattr(host.shutil, "disk_usage", lambda path: Usage(0, 0, 63 * MIB))
    said = pans.refuses(*words, "--decisions", "3")
    assert "63.0 MiB are free" in said
    assert "--disk-reserve-mb" in said
    assert not (tmp_path / "out").exists()
    assert main([*words, "--decisions", "3", "--disk-reserve-mb", "63"]) == 0
