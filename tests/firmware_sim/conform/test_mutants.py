"""Single faults planted in the C core and in the simulator: each is found by the rules that it breaks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from c_device import needs_compiler
from mutants import Mutant, broken_by, c_core, tried

from pans.instrument.profile import load_profile
from pans_sim.conform import RULES
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS
from pans_sim.scene.scene_file import open_scene

SOUND = ("1.1", "2.1", "4.1", "6.1")  # rules that no fault of the quick set touches
SLOW_LINE = 100_000  # bytes per second: a fifth of what the fastest stream of rule 6.6 brings

MUTANTS = {
    # -- frames
    "a CRC that is not looked at": Mutant(
        "frame.c",
        "return pans_crc32(crc_start(decoder->body[0]), decoder->body, count) == get32(decoder->body + count);",
        "return true;",
        {"1.2", "1.3"},
    ),
    "a frame cut off leaves its group behind": Mutant(
        "frame.c", "decoder->code = decoder->left = 0;", "decoder->code = 0;", {"1.5"}
    ),
    "after a frame that is too long all are skipped": Mutant(
        "frame.c", "        decoder->skipping = false;\n", "", {"1.6"}
    ),
    "a full group gets a zero behind it": Mutant(
        "frame.c", "if (decoder->code != 0 && decoder->code != 0xFF)", "if (decoder->code != 0)", {"1.9"}
    ),
    "a longer PING is taken": Mutant(
        "device.c", "body[0] == PING && count == 12", "body[0] == PING && count >= 12", {"1.12"}
    ),
    # -- sessions
    "a repeated HELLO starts afresh": Mutant(
        "device.c", "if (session == d->session && same) {", "if (session == 0 && same) {", {"2.2"}
    ),
    "a new session keeps the plan": Mutant("device.c", "    d->plan.complete = d->plan.adaptive = false;\n", "", {"2.3"}),
    "frames of another session are taken": Mutant(
        "device.c", "else if (d->session == 0 || session != d->session)", "else if (d->session == 0)", {"2.4"}
    ),
    "another schema gets a session": Mutant(
        "device.c", "d->session = same ? session : 0;", "d->session = session;", {"2.5"}
    ),
    "STATUS every other second": Mutant(
        "answers.c", "d->status_tick = d->tick + d->limits.tick_hz;", "d->status_tick = d->tick + 2 * d->limits.tick_hz;",
        {"2.7"},
    ),
    "another tick_hz than the profile's": Mutant(
        "answers.c", 'add_value(map, "tick_hz", l->tick_hz);', 'add_value(map, "tick_hz", l->tick_hz + 1);', {"3.2"}
    ),
    "one level": Mutant("answers.c", 'add_value(map, "levels", l->levels);', 'add_value(map, "levels", 1);', {"3.1"}),
    "automata of another schema": Mutant("internal.h", "0xD00A27FFu", "0xD00A27FEu", {"3.3"}),
    # -- commands
    "a repeated command is carried out": Mutant(
        "device.c", "if (id == d->ack.last + 1) {", "if (id == d->ack.last + 1 || id == d->ack.last) {", {"4.2"}
    ),
    "a command behind a gap is carried out": Mutant(
        "device.c", "if (id == d->ack.last + 1) {", "if (id > d->ack.last) {", {"4.3"}
    ),
    "the mask of refusals stands still": Mutant("device.c", "        d->ack.mask <<= 1;\n", "", {"4.4"}),
    "command ids of 8 bits": Mutant("device.c", "uint32_t id = get32(payload);", "uint32_t id = payload[0];", {"4.1"}),
    "command ids of 16 bits": Mutant(
        "device.c", "uint32_t id = get32(payload);", "uint32_t id = get16(payload);", {"4.21"}
    ),
    "an unknown opcode is out of range": Mutant("device.c", 'PANS_UNKNOWN, "opcode"', 'PANS_RANGE, "opcode"', {"4.5"}),
    "STOP with a body is carried out": Mutant("device.c", "    if (count != 0)\n", "    if (count > 1000)\n", {"4.6"}),
    "a level too many is malformed": Mutant(
        "patterns.c", 'PANS_RANGE, "level"', 'PANS_MALFORMED, "level"', {"4.7"}, profile="dmd-spad"
    ),
    "a pattern too many in a slot": Mutant(
        "plan.c", "if (pattern >= head->plan.n_patterns)", "if (pattern > head->plan.n_patterns)", {"4.8"}
    ),
    "ARM without its patterns": Mutant(
        "run.c", "    if (status == PANS_DONE)\n        status = prepare(d);\n",
        "    if (status == PANS_WRONG_STATE && d->plan.complete)\n        status = PANS_DONE;\n"
        "    else if (status == PANS_DONE)\n        status = prepare(d);\n", {"4.9"},
    ),
    "ARM with a start that has passed": Mutant(
        "run.c", "if (start <= d->tick)", "if (start + d->limits.tick_hz <= d->tick)", {"4.10"}
    ),
    "ARM while ARMED": Mutant("device.c", "bool needs_idle = opcode <= ARM", "bool needs_idle = opcode < ARM", {"4.11"}),
    "a gate that comes too late is taken": Mutant("gate.c", "    if (tick <= d->tick)\n", "    if (tick == 0)\n", {"4.12"}),
    "first pixel 0 goes on with a pattern": Mutant(
        "patterns.c", "*pattern = (struct pattern){piece->whole, 0};", "pattern->whole = piece->whole;", {"4.13"}
    ),
    # -- states and lease
    "a completed run is called stopped": Mutant(
        "device.c", "run_end(d, PANS_IDLE, COMPLETED);", "run_end(d, PANS_IDLE, STOPPED);", {"4.14"}
    ),
    "STOP without a reason": Mutant(
        "device.c", "    run_end(d, PANS_IDLE, STOPPED);\n    if (opcode == RESET",
        "    run_end(d, PANS_IDLE, NO_REASON);\n    if (opcode == RESET", {"4.15"},
    ),
    "the lease lasts a fifth longer": Mutant(
        "run.c", "d->tick + (ticks == 0 ? 1 : ticks);", "d->tick + ticks + ticks / 5;", {"4.16"}
    ),
    "a GRANT with 0 renews the lease": Mutant(
        "device.c", "if (lease_ms != 0 && d->run.active)\n        renew_lease(d, lease_ms);",
        "if (d->run.active)\n        renew_lease(d, lease_ms == 0 ? 300 : lease_ms);", {"4.17"},
    ),
    "a new session leaves SAFE": Mutant(
        "device.c", "    forget_session(d);\n    send_welcome", "    forget_session(d);\n    d->state = PANS_IDLE;\n    send_welcome",
        {"4.18"},
    ),
    # -- the stream
    "a number is skipped at 256": Mutant(
        "stream.c", "    s->sequence++;\n", "    s->sequence += s->sequence == 255 ? 2 : 1;\n", {"5.1"}
    ),
    "a sequence of 16 bits": Mutant(
        "stream.c", "put32(body + HEADER_BYTES, s->sequence);", "put32(body + HEADER_BYTES, (uint16_t)s->sequence);", {"5.11"}
    ),
    "drops of 16 bits": Mutant(
        "stream.c", "s->drops += exposures;", "s->drops = (uint16_t)(s->drops + exposures);", {"5.12"}
    ),
    "a tick of drift per cycle": Mutant(
        "edge.c", "place->cycle_tick += plan->cycle_ticks;", "place->cycle_tick += plan->cycle_ticks + 1;", {"5.11"}
    ),
    "blocks go on after a pause": Mutant(
        "run.c", " || gap_after(p, at->slot) != p->period_ticks)", ")", {"5.2"}
    ),
    "the pattern of the first slot in each stamp": Mutant(
        "stream.c", "2u * b->count, ended->stamp);", "2u * b->count, d->plan.pattern[0]);", {"5.3"}
    ),
    "a tick of the exposure's end": Mutant(
        "stream.c", "b->tick = ended->began;", "b->tick = ended->began + d->plan.exposure_ticks;", {"5.4"}
    ),
    "an object per cycle": Mutant(
        "edge.c", "if (++place->cycle_here < plan->cycles_per_object)", "if (++place->cycle_here < 1)", {"5.5"}
    ),
    "the window is ignored": Mutant(
        "stream.c", "return s->held != 0 && ahead != 0 && ahead < 0x80000000u;", "(void)ahead; return s->held != 0;", {"5.6"}
    ),
    "no drops in blocks": Mutant("stream.c", "put32(at + 4, d->stream.drops);", "put32(at + 4, 0);", {"5.7"}),
    "STOP counts the exposure under way": Mutant(
        "run.c", "    hold(d, true);\n    d->edges.on", "    if (d->edges.exposing)\n        pans_edge(d);\n"
        "    hold(d, true);\n    d->edges.on", {"5.8"},
    ),
    "bits of an earlier block": Mutant("stream.c", "(b->count % 8 == 0 ? 0 : *bits) |", "*bits |", {"5.9"}),
    "each STATUS counts on": Mutant("answers.c", "run_begun(d) : d->run.place.number", "run_begun(d) : d->run.place.number++", {"5.10"}),
    # -- probes
    "nanoseconds of 32 bits": Mutant(
        "answers.c", "put64(body + HEADER_BYTES + 4, d->pong[0].host_ns);",
        "put64(body + HEADER_BYTES + 4, (uint32_t)d->pong[0].host_ns);", {"6.1"},
    ),
    "a PING is answered twice": Mutant(
        "device.c", "        take_ping(d, payload);\n", "        take_ping(d, payload), take_ping(d, payload);\n", {"6.2"}
    ),
    "departure before arrival": Mutant(
        "answers.c", "put64(body + HEADER_BYTES + 20, d->tick);", "put64(body + HEADER_BYTES + 20, d->tick - 5);", {"6.3"}
    ),
    "answers starved by the stream": Mutant(
        "device.c", "if (stream && !(answers && d->stream_was_last)) {", "if (stream) {", {"6.6"}, SLOW_LINE
    ),
    # -- automata
    "masks with a byte too many": Mutant(
        "patterns.c", "count - 16 != masks * row", "count - 16 < masks * row", {"11.2"}
    ),
    "adaptive slots beside fixed ones": Mutant(
        "plan.c", "if (adaptive != 0 && fixed != 0)", "if (adaptive == UINT32_MAX && fixed != 0)", {"11.3"}
    ),
    "a dwell of 0": Mutant(
        "walk.c", "if (dwell == 0 || dwell > here->dwell_steps)", "if (dwell > here->dwell_steps)", {"11.4"}
    ),
    "ARM with half an automaton": Mutant(
        "run.c", "if (d->automaton.begun && !d->automaton.complete)", "if (d->automaton.n_states == 0xFFFF)", {"11.5"}
    ),
    "a walk that goes on into the next cycle": Mutant("edge.c", "        e->node = 0;\n", "        ;\n", {"11.6"}),
    "states of 8 bits": Mutant("edge.c", "e->stamp = named->state;", "e->stamp = (uint8_t)named->state;", {"11.7"}),
    "SHOW of an exposure that has begun": Mutant(
        "walk.c", "if (show.exposure < begun)", "if (show.exposure + UINT32_MAX < begun)", {"11.8"}
    ),
}  # fmt: skip

QUICK = (
    "a number is skipped at 256", "no drops in blocks", "STOP counts the exposure under way", "ARM without its patterns",
    "a tick of the exposure's end", "a sequence of 16 bits", "drops of 16 bits",
    "a tick of drift per cycle", "answers starved by the stream", "the lease lasts a fifth longer",
    "a repeated command is carried out",
)  # fmt: skip


def test_the_faults_are_many_and_name_rules() -> None:
    assert len(MUTANTS) >= 35
    assert all(mutant.rules and mutant.rules <= RULES.keys() for mutant in MUTANTS.values())
    assert {*QUICK} <= MUTANTS.keys()


@needs_compiler
@pytest.mark.parametrize("fault", QUICK)
def test_a_planted_fault_is_found_by_the_rule_that_it_breaks(fault: str, tmp_path: Path) -> None:
    rules = MUTANTS[fault].rules
    assert broken_by(MUTANTS[fault], tmp_path, *rules, *SOUND) == rules


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("fault", MUTANTS)
def test_each_planted_fault_is_found(fault: str, tmp_path: Path) -> None:
    rules = MUTANTS[fault].rules
    long = any(RULES[number].long for number in rules)
    broken = broken_by(MUTANTS[fault], tmp_path, long=long)
    assert rules <= broken, f"broken are {sorted(broken)}"


@needs_compiler
def test_a_line_that_the_stream_fills_is_no_fault() -> None:
    found = tried("ideal", *c_core("ideal", line_bytes_s=SLOW_LINE))
    assert {number: one.why for number, one in found.items() if one.verdict in ("broken", "gone")} == {}


class UnderCounting(Instrument):
    """Leaves one exposure out of every EXPOSED."""

    def _send_exposed(self, ended: int) -> None:
        super()._send_exposed(ended - 1)
        self._exposures_told = ended


class TellingBehind(Instrument):
    """Sends EXPOSED behind STATUS."""

    def _send_status(self) -> None:
        super()._send_status()
        self._out[-2:] = self._out[:-3:-1]


class Denying(Instrument):
    """Tells of exposures that are on the tick, whenever they were."""

    def _send_exposed(self, ended: int) -> None:
        self._errors = 0, 0
        super()._send_exposed(ended)


class Unannounced(Instrument):
    """Sends EXPOSED, and does not say so."""

    def _facts(self) -> dict[str, Any]:
        return {key: value for key, value in super()._facts().items() if key != "exposed_schema"}


@pytest.mark.parametrize(
    ("kind", "late_us", "short_us", "broken"),
    [
        (Instrument, 0.0, 0.0, set()),
        (Instrument, 5.0, 0.0, {"15.2"}),
        (Instrument, 0.0, 5.0, {"15.2"}),
        (UnderCounting, 0.0, 0.0, {"15.1"}),
        (TellingBehind, 0.0, 0.0, {"15.1"}),
        (Denying, 5.0, 0.0, {"15.2"}),
        (Unannounced, 0.0, 0.0, {"15.1"}),
    ],
    ids=lambda one: getattr(one, "__name__", None),
)
@pytest.mark.parametrize("name", ["ideal", "wdm-snspd"])
def test_a_device_that_is_wrong_about_its_exposures_is_found(
    name: str, kind: type[Instrument], late_us: float, short_us: float, broken: set[str]
) -> None:
    profile, clock = load_profile(name), DeviceClock(load_profile(name).clock.tick_hz)
    errors = {"exposure_late_us": late_us, "exposure_short_us": short_us}
    device = kind(profile, open_scene("uniform"), power_on_tick=clock.tick_at(START_NS), **errors)  # type: ignore[arg-type]
    found = tried(name, device, clock, "4.1", "15.1", "15.2")
    assert {number for number, one in found.items() if one.verdict == "broken"} == broken
