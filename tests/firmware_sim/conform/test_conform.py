"""The conformance kit: both devices keep every rule, devices that go away leave their findings, the document says the rules."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from c_device import needs_compiler
from mutants import Mutant, built, c_core, tried
from tree import ROOT

from pans.app.main import main
from pans.base.errors import LinkError
from pans.instrument.profile import load_profile
from pans.protocol.wire import MessageType, Opcode
from pans.protocol.wire.framing import FrameDecoder
from pans_sim.conform import RULES, Finding, conform
from pans_sim.device.clock import DeviceClock
from pans_sim.ports.serve import SimOptions, build_instrument
from pans_sim.ports.virtual import START_NS, VirtualLink

BEYOND = {"2.8", "4.20"}  # no link can show them
LONG = {number for number, rule in RULES.items() if rule.long}
SOME = ("1.1", "5.1")  # before and beside the long ones
SOON_S = 60.0  # of the link's clock: a device that crashed, fell silent or sends damaged frames keeps nobody longer
RECEIVED = "    d->counters.frames++;\n"
DEAF_AFTER_GATE = Mutant(
    "device.c",
    RECEIVED,
    "    static bool deaf;\n    deaf = deaf || (body[0] == COMMAND && payload[4] == GATE);\n"
    "    if (deaf)\n        return;\n" + RECEIVED,
    {"4.12"},
)
OTHER_CRC = Mutant("frame.c", "? 0 : PANS_SCHEMA;", "? 0 : PANS_SCHEMA ^ 1;", {"1.2"})


@pytest.mark.parametrize("name", ["ideal", "dmd-four-snspd", "dmd-qcmos", "oled-qcmos", "wdm-snspd"])
def test_the_simulator_keeps_every_rule(name: str) -> None:
    device, clock = build_instrument(SimOptions(name, "uniform"), START_NS)
    found = tried(name, device, clock)
    assert set(found) == set(RULES)
    assert {number: one.why for number, one in found.items() if one.verdict == "broken"} == {}
    kept = {number for number, one in found.items() if one.verdict == "kept"}
    assert {number for number in RULES if number[:2] not in ("11", "13", "14")} - kept == BEYOND | LONG
    assert found["1.3"].pieces
    assert {"14.3", "14.4"} <= kept or name != "dmd-four-snspd"


@needs_compiler
@pytest.mark.parametrize("name", ["ideal", "dmd-spad", "wdm-snspd"])
def test_the_reference_instrument_keeps_every_rule(name: str) -> None:
    found = tried(name, *c_core(name))
    assert {number: one.why for number, one in found.items() if one.verdict == "broken"} == {}
    assert {
        number
        for number, one in found.items()
        if one.verdict == "not tried" and number[:2] not in ("11", "13", "14", "15")
    } == BEYOND | LONG


@pytest.mark.parametrize("name", ["ideal", pytest.param("dmd-spad", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "core",
    [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=needs_compiler)],
    ids=["simulator", "C core"],
)
def test_both_devices_keep_the_long_rules(name: str, core: bool) -> None:
    device = c_core(name) if core else build_instrument(SimOptions(name, "uniform"), START_NS)
    found = tried(name, *device, *SOME, *LONG)
    assert {number: one.why for number, one in found.items() if one.verdict != "kept"} == {}


def mutated(mutant: Mutant, tmp_path: Path) -> tuple[list[Finding], float]:
    """Findings of all rules on this mutant, and how many seconds the link's clock went on."""
    device, clock = c_core("ideal", built(mutant, tmp_path))
    link = VirtualLink(device, clock, "conform")
    findings = conform(link, load_profile("ideal"), pixels=16)
    return findings, (link.now_ns() - START_NS) * 1e-9


@needs_compiler
def test_a_device_that_falls_silent_ends_the_test_with_its_findings(tmp_path: Path) -> None:
    findings, seconds = mutated(DEAF_AFTER_GATE, tmp_path)
    verdicts = {one.number: one.verdict for one in findings}
    assert seconds < SOON_S
    assert [number for number, verdict in verdicts.items() if verdict == "gone"] == ["4.12"]
    assert verdicts["1.1"] == verdicts["4.11"] == "kept"
    assert (
        verdicts["4.13"] == verdicts["4.14"] == verdicts["4.15"] == "not tried"
    )  # the device was asked three times more
    assert {one.why for one in findings if one.number[0] == "5" and one.number not in LONG} == {
        "the device went away in rule 4.12"
    }


@needs_compiler
def test_frames_with_another_crc_are_counted_and_named(tmp_path: Path) -> None:
    findings, seconds = mutated(OTHER_CRC, tmp_path)
    assert seconds < SOON_S
    first = next(one for one in findings if one.number == "1.2")
    assert first.verdict == "broken"
    assert re.search(r"[1-9][0-9]* frames? arrived with a wrong CRC: check the CRC's start value", first.why)
    assert findings[-1].verdict == "not tried"


def test_a_device_that_goes_away_leaves_the_findings_before(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Leaving(VirtualLink):
        """It is gone when it is asked for a gate."""

        def write(self, data: bytes) -> None:
            frames = FrameDecoder().feed(data)
            if any(frame.type == MessageType.COMMAND and frame.payload[4] == Opcode.GATE for frame in frames):
                raise LinkError("the device went away")
            super().write(data)

    def opened(url: str) -> VirtualLink:
        return Leaving(*build_instrument(SimOptions("ideal", "uniform"), START_NS), url)

    monkeypatch.setattr("pans_sim.commands.conform.open_link", opened)
    rules = [word for number in ("4.1", "4.12", "5.1") for word in ("--rule", number)]
    words = ["conform", "sim:ideal", "--pixels", "16", *rules]
    assert main([*words, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["kept"], found["broken"], found["gone"]) == ("FAIL", 1, [], "4.12")
    assert [one["verdict"] for one in found["rules"]] == ["kept", "gone", "not tried"]
    assert main(words) == 3
    assert "the device went away in rule 4.12" in capsys.readouterr().out


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
