"""The conformance kit: both devices keep every rule, planted faults are found by the rules that they break, the document says them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from c_device import needs_compiler
from tree import ROOT

from pans.firmware_sim.conform import RULES, Finding, conform
from pans.firmware_sim.device.clock import DeviceClock, SteppedDevice
from pans.firmware_sim.engine import SteppedEngine, build, engine_library
from pans.firmware_sim.ports.serve import SimOptions, build_instrument
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.runtime.cli import main
from pans.runtime.errors import LinkError
from pans.runtime.instrument.profile import load_profile

BEYOND = {"2.8", "4.20"}  # no link can show them
SOUND = ("1.1", "2.1", "4.1", "5.2", "6.1")  # rules that none of the faults touches
# Faults in copies of the C sources: file, what stands there, what takes its place; and the rules that must find each.
FAULTS = {
    "the lease lasts a fifth longer": (
        "run.c", "d->tick + (ticks == 0 ? 1 : ticks);", "d->tick + ticks + ticks / 5;", {"4.16"},
    ),
    "a repeated command is carried out": (
        "device.c", "if (id == d->ack.last + 1) {", "if (id == d->ack.last + 1 || id == d->ack.last) {", {"4.2"},
    ),
    "drops are not counted": ("stream.c", "s->drops += exposures;", "(void)exposures;", {"5.7"}),
    "the CRC is not looked at": (
        "frame.c",
        "return pans_crc32(crc_start(decoder->body[0]), decoder->body, count) == get32(decoder->body + count);",
        "return true;",
        {"1.2", "1.3"},
    ),
    "the lease lasts a fifth less": (
        "run.c", "d->tick + (ticks == 0 ? 1 : ticks);", "d->tick + ticks - ticks / 5;", {"4.16"},
    ),
    "drops are counted twice": ("stream.c", "s->drops += exposures;", "s->drops += 2 * exposures;", {"5.7"}),
    "the window is ignored": (
        "stream.c",
        "return s->held != 0 && ahead != 0 && ahead < 0x80000000u;",
        "(void)ahead; return s->held != 0;",
        {"5.6"},
    ),
    "departure before arrival": (
        "answers.c",
        "put64(body + HEADER_BYTES + 20, d->tick);",
        "put64(body + HEADER_BYTES + 20, d->tick - 5);",
        {"6.3"},
    ),
    "exposures too early": (
        "run.c", ".next_tick = start + d->plan.start[0],", ".next_tick = start + d->plan.start[0] - 50,", {"5.4"},
    ),
    "a walk that ignores its click": (
        "walk.c",
        "d->automaton.row[d->run.node].next[click];",
        "d->automaton.row[d->run.node].next[click & 0];",
        {"11.6"},
    ),
}  # fmt: skip


def tried(name: str, device: SteppedDevice, clock: DeviceClock, *only: str) -> dict[str, Finding]:
    link = VirtualLink(device, clock, "conform")
    return {one.number: one for one in conform(link, load_profile(name), pixels=16, only=only)}


def engine(name: str, library: Path | None = None, scene: str = "uniform") -> tuple[SteppedEngine, DeviceClock]:
    clock = DeviceClock(load_profile(name).clock.tick_hz)
    return SteppedEngine(SimOptions(name, scene), clock.tick_at(START_NS), library=library), clock


@pytest.mark.parametrize("name", ["ideal", "dmd-four-snspd", "dmd-qcmos", "oled-qcmos", "wdm-snspd"])
def test_the_simulator_keeps_every_rule(name: str) -> None:
    device, clock = build_instrument(SimOptions(name, "uniform"), START_NS)
    found = tried(name, device, clock)
    assert set(found) == set(RULES)
    assert {number: one.why for number, one in found.items() if one.verdict == "broken"} == {}
    kept = {number for number, one in found.items() if one.verdict == "kept"}
    assert {number for number in RULES if number[:2] not in ("11", "13", "14")} - kept == BEYOND
    assert found["1.3"].pieces
    assert {"14.3", "14.4"} <= kept or name != "dmd-four-snspd"


@needs_compiler
@pytest.mark.parametrize("name", ["ideal", "dmd-spad", "wdm-snspd"])
def test_the_reference_instrument_keeps_every_rule(name: str) -> None:
    found = tried(name, *engine(name))
    assert {number: one.why for number, one in found.items() if one.verdict == "broken"} == {}
    assert {
        number for number, one in found.items() if one.verdict == "not tried" and number[:2] not in ("11", "13", "14")
    } == BEYOND


@needs_compiler
@pytest.mark.parametrize("fault", list(FAULTS)[:4])
def test_a_planted_fault_is_found_by_the_rule_that_it_breaks(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rules = FAULTS[fault][3]
    assert broken_by(fault, tmp_path, monkeypatch, *rules, *SOUND) == rules


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_breaks_few_other_rules(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rules, broken = FAULTS[fault][3], broken_by(fault, tmp_path, monkeypatch)
    assert rules <= broken
    assert len(broken - rules) <= 3, f"also {broken - rules}"


def broken_by(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *only: str) -> set[str]:
    """The rules that a copy of the C core with this fault breaks."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(build, "FLAGS", ("-std=c99", "-O0"))
    name, sound, planted, _ = FAULTS[fault]
    folder = tmp_path / "sources"
    for path in build.FOLDER.rglob("*.[ch]"):
        copy = folder / path.relative_to(build.FOLDER)
        copy.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text()
        if path.name == name:
            assert text.count(sound) == 1, f"{name} no longer says {sound!r}"
            text = text.replace(sound, planted)
        copy.write_text(text)
    found = tried("ideal", *engine("ideal", engine_library(folder)), *only)
    broken = {number for number, one in found.items() if one.verdict == "broken"}
    assert all(found[number].why and found[number].pieces for number in broken)
    return broken


def test_a_device_that_says_nothing_is_no_device() -> None:
    class Nothing:
        session = 0

        def step(self, tick: int, data: bytes) -> bytes:
            return b""

        def next_event_tick(self) -> int | None:
            return None

        def draw_ahead(self) -> bool:
            return False

    with pytest.raises(LinkError, match="no WELCOME"):
        tried("ideal", Nothing(), DeviceClock(1_000_000))


def test_the_document_says_the_same_rules() -> None:
    text = (ROOT / "docs/reference/protocol.md").read_text()
    rows = re.findall(r'^\| <a id="rule-([0-9-]+)"></a>([0-9.]+) \| (.*) \|$', text, re.MULTILINE)
    assert all(anchor == number.replace(".", "-") for anchor, number, _ in rows)
    said = {number: words for _, number, words in rows}
    expected = {
        number: rule.words + ("" if rule.check else f" *(not over the link: {rule.why})*")
        for number, rule in RULES.items()
    }
    assert said == expected


def test_the_command_gives_a_verdict_and_the_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    url = "sim:ideal?scene=uniform&pace=fast"
    assert main(["conform", url, "--rule", "1.3", "--rule", "2.8", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["kept"], found["broken"], found["not_tried"]) == ("PASS", 1, [], 1)
    assert {way for way, _, _ in found["rules"][0]["bytes"]} == {">", "<"}
    assert main(["conform", url, "--rule", "4.5", "--bytes"]) == 0
    assert "> 0" in capsys.readouterr().out
    assert main(["conform", url, "--rule", "99.1"]) == 2
    # patterns of another size than the scene's pictures: the device refuses ARM, and the kit says so
    assert main(["conform", "sim:ideal?pace=fast", "--pixels", "9", "--rule", "5.1"]) == 1
    assert "refused" in capsys.readouterr().out
