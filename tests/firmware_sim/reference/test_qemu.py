"""The firmware as an Arm image in QEMU: exposures on the tick, in instructions; every rule; decisions of the shipped automaton.

Times are those of the emulated processor, so that they are the same on every machine. Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi
qemu-system-arm.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import qemu_link
from commands import json_of
from lock_step import open_links, register
from qemu_link import CPUS, build, canned_log, instructions

from pans.instrument.profile import profile_text

pytestmark = pytest.mark.skipif(bool(qemu_link.missing()), reason=f"{qemu_link.missing()} is not installed")

N_EXPOSURES = 3300
A_MICROSECOND = instructions(25)
MOST_TO_NEXT_PATTERN = 500
AS_EMULATED = {
    'name = "dmd-spad"': 'name = "mps2"',
    "pattern_memory = 43_690": "pattern_memory = 4_096",
    "automaton_states = 43_690": "automaton_states = 4_096",
    "afterpulse_probability = 0.005": "afterpulse_probability = 0.0",
    "tick_hz = 100_000_000": "tick_hz = 25_000_000",
}


def figures(log: str) -> dict[str, int]:
    """The named numbers of a log."""
    return {name: int(number) for name, number in re.findall(r"^([a-z]\w+) (\d+)$", log, re.MULTILINE)}


def latest_start(log: str) -> int:
    """In instructions, of the exposures that the log tells one by one: number, ticks late, ticks long."""
    rows = [tuple(map(int, words)) for words in re.findall(r"^(\d+) (\d+) (\d+)$", log, re.MULTILINE)]
    assert [row[0] for row in rows] == list(range(N_EXPOSURES))
    return instructions(max(row[1] for row in rows))


@pytest.mark.parametrize("cpu", CPUS)
def test_exposures_start_on_the_tick_and_the_next_pattern_is_chosen_at_once(cpu: str, tmp_path: Path) -> None:
    image = build(tmp_path, cpu, "canned")
    log = canned_log(image, tmp_path / "first")
    if cpu == "m0plus":
        assert canned_log(image, tmp_path / "second") == log
    assert latest_start(log) <= A_MICROSECOND
    found = figures(log)
    assert found["latest_start_ticks"] == max(int(late) for late in re.findall(r"^\d+ (\d+) \d+$", log, re.MULTILINE))
    assert instructions(found["longest_choice_ticks"]) <= MOST_TO_NEXT_PATTERN
    assert instructions(found["latest_gate_ticks"]) <= A_MICROSECOND
    assert found["stack_bytes"] < 1024


def test_one_start_that_is_late_by_2_us_is_found(tmp_path: Path) -> None:
    assert (
        latest_start(canned_log(build(tmp_path, "m0plus", "canned", "DELAY_ONE=50"), tmp_path / "log")) > A_MICROSECOND
    )


def test_firmware_without_an_interrupt_is_late(tmp_path: Path) -> None:
    assert latest_start(canned_log(build(tmp_path, "m0plus", "canned", "POLLED"), tmp_path / "log")) > 2 * A_MICROSECOND


@pytest.fixture
def emulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., list[str]]]:
    """Builds the M0+ image for a line in lock-step; returns device and profile as words of a command."""
    text = profile_text("dmd-spad")
    for shipped, here in AS_EMULATED.items():
        assert shipped in text
        text = text.replace(shipped, here)
    (tmp_path / "mps2.toml").write_text(text)
    monkeypatch.syspath_prepend(register(tmp_path / "site", "qemu", "qemu_link:open_qemu"))

    def made(*defines: str) -> list[str]:
        return [f"qemu:{build(tmp_path, 'm0plus', 'lockstep', *defines)}", "--profile", str(tmp_path / "mps2.toml")]

    yield made
    while open_links:
        open_links.pop().end()


def test_the_image_keeps_every_rule(emulated: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    found = json_of(capsys, "conform", *emulated())
    assert (found["verdict"], found["broken"], found["gone"]) == ("PASS", [], None)
    assert found["kept"] >= 78


def run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], decisions: int, code: int
) -> dict[str, Any]:
    device, *profile = words
    more = (
        "--device",
        device,
        *profile,
        "--decisions",
        str(decisions),
        "--drive",
        "device",
        "--out",
        str(tmp_path / "run"),
    )
    return json_of(capsys, "run fashion-adaptive", *more, code=code)


def test_the_image_decides_as_expected(
    emulated: Callable[..., list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = run(capsys, tmp_path, emulated(), 200, 0)
    assert found["verdict"] == "PASS"
    expected = found["expected"]["accuracy"]  # of the whole test set, of which these are 200 images
    assert abs(found["accuracy"] - expected) <= 2 * math.sqrt(expected * (1 - expected) / 200)
    timing = found["exposure_timing"]
    assert timing["within"]
    assert timing["exposures"] == 200 * 33
    assert max(abs(timing["worst_start_us"]), abs(timing["worst_length_us"])) <= 1


def test_light_that_comes_late_is_judged(
    emulated: Callable[..., list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = run(capsys, tmp_path, emulated("POLLED"), 40, 4)
    assert found["verdict"] == "FAIL"
    assert found["exposure_timing"]["worst_start_us"] > 2 * found["exposure_timing"]["tolerance_us"]
    assert [fault for fault in found["faults"] if "exposure_tolerance_us" in fault]
