"""More single changes of the C core, in all of its files: each is named by a rule, or no link can show it, or the protocol permits it."""

from __future__ import annotations

from pathlib import Path

import pytest
from c_device import needs_compiler
from mutants import Mutant, broken_by, tried

from pans.instrument.profile import load_profile
from pans_sim.conform import RULES
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS
from pans_sim.scene.scene_file import open_scene

SLOW_LINE = 100_000  # bytes per second

# What a stranger planted and the rules missed.
MISSED_ONCE = {
    "names of begun exposures keep their place": Mutant(
        "walk.c", "    forget_shown(shows, begun);\n",
        "",
        {"11.9"},
    ),
    "walks wrong behind step 8": Mutant(
        "edge.c", "next[word[0] & 1];",
        "next[e->place.slot < 8 ? word[0] & 1 : 0];",
        {"11.6"},
    ),
    "object numbers go on over ARM": Mutant(
        "run.c", ".place = {.cycle_tick = start},",
        ".place = {.cycle_tick = start, .object = d->run.place.object},",
        {"5.5"},
    ),
    "the lease stands still while ARMED": Mutant(
        "device.c", "} else if (d->run.active && d->run.lease_tick <= d->tick) {",
        "} else if (d->state == PANS_ARMED && d->run.lease_tick <= d->tick) {\n        d->run.lease_tick += d->limits.tick_hz;\n"
        "    } else if (d->run.active && d->run.lease_tick <= d->tick) {",
        {"4.16"},
    ),
    "a lease beyond the maximum": Mutant(
        "run.c", "uint64_t ms = lease_ms > MAX_LEASE_MS ? MAX_LEASE_MS : lease_ms,",
        "uint64_t ms = lease_ms,",
        {"4.23"},
    ),
    "a piece of a plan with another head": Mutant(
        "plan.c", "head.first_slot != p->filled || !same_head(&head.plan, p)))",
        "head.first_slot != p->filled))",
        {"4.22"},
    ),
    "a piece of a plan over an earlier one": Mutant(
        "plan.c", "(p->filled == 0 || head.first_slot != p->filled ||",
        "(p->filled == 0 || head.first_slot > p->filled ||",
        {"4.22"},
    ),
    "states with another head": Mutant(
        "walk.c", "!a->begun || a->complete || !same ||",
        "!a->begun || a->complete || (!same && false) ||",
        {"11.11"},
    ),
    "states over earlier ones": Mutant(
        "walk.c", "!same || here->first != a->filled))",
        "!same || here->first > a->filled))",
        {"11.11"},
    ),
    "no gap from the last slot to the first": Mutant(
        "plan.c", "        if (gap < needed)\n",
        "        if (gap < needed && i + 1 < p->n_slots)\n",
        {"4.8"},
    ),
    "levels of the first pixel": Mutant(
        "patterns.c", "for (uint32_t i = 0; i < pixels; i++) {\n        uint16_t level",
        "for (uint32_t i = 0; i < 1; i++) {\n        uint16_t level",
        {"4.7"}, profile="dmd-spad",
    ),
    "words of 3 bytes": Mutant(
        "plan.c", "return bytes <= 4 ? 4 :",
        "return bytes <= 4 ? bytes :",
        {"5.3"}, profile="wdm-snspd",
    ),
    "words of 2 bytes above 16 channels": Mutant(
        "plan.c", "return bytes <= 4 ? 4 :",
        "return bytes <= 4 ? 2 :",
        {"5.3"}, profile="wdm-snspd",
    ),
    "session 0": Mutant(
        "device.c", "body[0] == HELLO && count >= 8 && session != 0)",
        "body[0] == HELLO && count >= 8)",
        {"2.9"},
    ),
    "exposures of SHOW in 16 bits": Mutant(
        "walk.c", "struct show show = {get64(body),",
        "struct show show = {get16(body),",
        {"11.7"},
    ),
    "reserved bytes of the header": Mutant(
        "frame.c", "put32(body, (uint32_t)type);",
        "put32(body, (uint32_t)type | 0x5A0000);",
        {"1.13"},
    ),
    "reserved bytes of STATUS": Mutant(
        "answers.c", "    put16(at + 2, 0);\n",
        "    put16(at + 2, 7);\n",
        {"1.13"},
    ),
    "reserved bytes of CLICKS": Mutant(
        "stream.c", "uint16_t bytes = frames ? word_bytes(d->plan.n_patterns) : 0;",
        "uint16_t bytes = frames ? word_bytes(d->plan.n_patterns) : 1;",
        {"1.13"},
    ),
    "reserved bytes of WELCOME": Mutant(
        "answers.c", "    put16(at + 6, 0);\n",
        "    put16(at + 6, 7);\n",
        {"1.13"},
    ),
    "PONGs last in, first out": Mutant(
        "answers.c", "    d->pong[d->n_pongs++] = (struct pong)",
        "    memmove(d->pong + 1, d->pong, d->n_pongs * sizeof d->pong[0]);\n    d->n_pongs++;\n    d->pong[0] = (struct pong)",
        {"6.7"},
    ),
    "the lease in whole seconds": Mutant(
        "answers.c", "(uint32_t)(left / hz * 1000 + left % hz * 1000 / hz));",
        "(uint32_t)(left / hz * 1000));",
        {"4.23"},
    ),
    "next exposure of those ended": Mutant(
        "run.c", "uint64_t begun = d->edges.place.number + d->edges.exposing;\n    hold(d, false);\n    return begun;",
        "uint64_t begun = d->edges.place.number;\n    hold(d, false);\n    return begun;",
        {"5.13"},
    ),
    "WELCOME of tick 0": Mutant(
        "answers.c", 'add_value(map, "tick", d->tick);',
        'add_value(map, "tick", 0);',
        {"3.4"},
    ),
    "twice the buffer": Mutant(
        "answers.c", '"buffer_messages", l->buffer_messages);',
        '"buffer_messages", 2u * l->buffer_messages);',
        {"5.7"},
    ),
    "a repeated HELLO without STATUS": Mutant(
        "device.c", "        send_welcome(d, session);\n        send_status(d);\n        return;",
        "        send_welcome(d, session);\n        return;",
        {"2.2"},
    ),
    "a dropped MARK is a drop": Mutant(
        "stream.c", "put(d, body, HEADER_BYTES + 32, MARK, 0);",
        "put(d, body, HEADER_BYTES + 32, MARK, 1);",
        {"5.7"},
    ),
}  # fmt: skip

# Chosen by reading the C files, before any was tried.
CHOSEN = {
    "groups of 253": Mutant(
        "frame.c", "code == 0xFF) {",
        "code == 0xFE) {",
        {"11.6"},
    ),
    "a ring wraps a byte late": Mutant(
        "frame.c", "return place >= ring->size ? place - ring->size : place;",
        "return place > ring->size ? place - ring->size : place;",
        {"1.4"},
    ),
    "no delimiter of a frame that wraps": Mutant(
        "frame.c", "straight + (uint32_t)(end - ring->at) + 1;",
        "straight + (uint32_t)(end - ring->at);",
        {"1.4"},
    ),
    "WELCOME with the CRC of the others": Mutant(
        "frame.c", "type == HELLO || type == WELCOME ?",
        "type == HELLO ?",
        {"1.1"},
    ),
    "two probes at once": Mutant(
        "internal.h", "#define PONGS 8u",
        "#define PONGS 2u",
        {"6.7"},
    ),
    "get64 of 48 bits": Mutant(
        "bytes.h", "(uint64_t)get32(at + 4) << 32;",
        "(uint64_t)get16(at + 4) << 32;",
        {"6.1"},
    ),
    "the text of ACK a byte short": Mutant(
        "answers.c", "put16(at + 14, d->ack.text_bytes);",
        "put16(at + 14, (uint16_t)(d->ack.text_bytes + 1));",
        {"4.4"},
    ),
    "refused id forgotten by the next command": Mutant(
        "answers.c", "put32(at + 4, d->ack.refused);",
        "put32(at + 4, d->ack.mask & 1 ? d->ack.refused : 0);",
        {"4.4"},
    ),
    "no drops in STATUS": Mutant(
        "answers.c", "put32(at + 8, d->stream.drops);",
        "put32(at + 8, 0);",
        {"5.7"},
    ),
    "the tick of the next STATUS": Mutant(
        "answers.c", "put64(at + 12, d->tick);",
        "put64(at + 12, d->status_tick);",
        {"2.7"},
    ),
    "another epoch in each WELCOME": Mutant(
        "answers.c", 'add_value(map, "epoch", l->epoch);',
        'add_value(map, "epoch", l->epoch + d->tick);',
        {"2.6"},
    ),
    "a pattern more than is announced": Mutant(
        "answers.c", '"pattern_memory", l->pattern_memory);',
        '"pattern_memory", l->pattern_memory - 1u);',
        {"4.7"}, profile="dmd-spad",
    ),
    "half of the announced slots": Mutant(
        "answers.c", '"slot_memory", l->slot_memory);',
        '"slot_memory", 2u * l->slot_memory);',
        {"3.5"},
    ),
    "the window outlives the session": Mutant(
        "device.c", "    d->stream.limit = 0;\n",
        "",
        {"5.6"},
    ),
    "PONGs outlive the session": Mutant(
        "device.c", "    d->n_pongs = 0;\n",
        "",
        {"2.4"},
    ),
    "any protocol version": Mutant(
        "device.c", "get32(payload) == PANS_SCHEMA && get16(payload + 4) == PANS_PROTOCOL;",
        "get32(payload) == PANS_SCHEMA;",
        {"2.5"},
    ),
    "RESET ends no run": Mutant(
        "device.c", "    run_end(d, PANS_IDLE, STOPPED);\n    if (opcode == RESET",
        "    if (opcode == STOP)\n        run_end(d, PANS_IDLE, STOPPED);\n    if (opcode == RESET",
        {"4.15"},
    ),
    "STOP leaves SAFE": Mutant(
        "device.c", "if (opcode == RESET && d->state == PANS_SAFE)",
        "if (d->state == PANS_SAFE)",
        {"4.18"},
    ),
    "LOAD_MASKS while ARMED": Mutant(
        "device.c", "|| opcode == LOAD_MASKS || opcode == LOAD_STATES;",
        "|| opcode == LOAD_STATES;",
        {"11.10"},
    ),
    "LOAD_STATES while ARMED": Mutant(
        "device.c", "|| opcode == LOAD_MASKS || opcode == LOAD_STATES;",
        "|| opcode == LOAD_MASKS;",
        {"11.10"},
    ),
    "a repetition is not acknowledged": Mutant(
        "device.c", "        d->counters.repeated++;\n",
        "        d->counters.repeated++;\n        return;\n",
        {"4.2"},
    ),
    "the window never goes back": Mutant(
        "device.c", "    d->stream.limit = get32(payload);\n",
        "    if (get32(payload) > d->stream.limit)\n        d->stream.limit = get32(payload);\n",
        {"5.6"},
    ),
    "PONG behind the stream": Mutant(
        "device.c", "    if (d->n_pongs != 0) {",
        "    if (d->n_pongs != 0 && !stream_may_send(d)) {",
        {"6.6"}, SLOW_LINE,
    ),
    "a longer GRANT is taken": Mutant(
        "device.c", "body[0] == GRANT && count == 8",
        "body[0] == GRANT && count >= 8",
        {"1.12"},
    ),
    "lease in 32 bits": Mutant(
        "run.c", "ticks = ms * d->limits.tick_hz / 1000;",
        "ticks = (uint32_t)(ms * d->limits.tick_hz) / 1000;",
        {"4.23"},
    ),
    "the last of equal errors": Mutant(
        "run.c", "(start < 0 ? -start : start) > (e->start",
        "(start < 0 ? -start : start) >= (e->start",
        {"15.1"},
    ),
    "MARK at the cycle's start": Mutant(
        "run.c", "at->cycle_tick + d->plan.start[0]);\n    run->marked",
        "at->cycle_tick);\n    run->marked",
        {"5.5"},
    ),
    "blocks end at an object only": Mutant(
        "run.c", "at->slot + 1 == p->n_slots ||",
        "(at->slot + 1 == p->n_slots && at->cycle_here + 1 == p->cycles_per_object) ||",
        {"5.2"},
    ),
    "a window of 2^31": Mutant(
        "stream.c", "ahead < 0x80000000u;",
        "ahead <= 0x80000000u;",
        {"5.6"},
    ),
    "no spacing in a block of one": Mutant(
        "stream.c", "put32(at + 24, d->plan.period_ticks);",
        "put32(at + 24, n == 1 ? d->plan.exposure_ticks : d->plan.period_ticks);",
        {"5.2"},
    ),
    "bits from the top": Mutant(
        "stream.c", "(word[0] & 1) << b->count % 8);",
        "(word[0] & 1) << (7 - b->count % 8));",
        {"5.9"},
    ),
    "MARK of a moving object": Mutant(
        "stream.c", "put16(at + 10, 0);",
        "put16(at + 10, 1);",
        {"5.5"},
    ),
    "drops outlive the run": Mutant(
        "stream.c", "s->sequence = s->held = s->drops = 0;",
        "s->sequence = s->held = 0;",
        {"5.7"},
    ),
    "the tick of the block's last exposure": Mutant(
        "stream.c", "    if (b->count == 0) {\n        b->tick = ended->began;",
        "    b->tick = ended->began;\n    if (b->count == 0) {",
        {"5.4"},
    ),
    "a name that comes when the exposure is next": Mutant(
        "edge.c", "    if (!e->exposing && e->tick != PANS_NEVER &&",
        "    if (!e->exposing && e->place.number == 0 && e->tick != PANS_NEVER &&",
        {"11.7"},
    ),
    "objects of 8 bits": Mutant(
        "edge.c", "    if (++place->object == NO_OBJECT)",
        "    if (++place->object == 0x100)",
        {"5.5"},
    ),
    "spacing of 0": Mutant(
        "plan.c", "if (p->period_ticks == 0)",
        "if (p->exposure_ticks == 0)",
        {"4.8"},
    ),
    "slots in any order": Mutant(
        "plan.c", "i + 1 < p->n_slots && p->start[i + 1] <= p->start[i];",
        "i + 1 < p->n_slots && p->start[i + 1] == p->start[i];",
        {"4.8"},
    ),
    "a full piece of a plan is refused": Mutant(
        "plan.c", "#define MAX_SLOTS_HERE 1024u",
        "#define MAX_SLOTS_HERE 1023u",
        {"3.5"},
    ),
    "states outlive the plan": Mutant(
        "plan.c", "        *p = head.plan;\n        forget_states(d);\n",
        "        *p = head.plan;\n",
        {"11.3"},
    ),
    "a refused plan can be armed": Mutant(
        "plan.c", "p->complete = status == PANS_DONE;",
        "p->complete = true;",
        {"4.9"},
    ),
    "a piece of a pattern of another size": Mutant(
        "patterns.c", "(piece->first != known->filled || piece->whole != known->whole)",
        "(piece->first != known->filled)",
        {"4.13"},
    ),
    "any number of levels": Mutant(
        "patterns.c", " || (count - 12) / 2 > MAX_LEVELS_HERE)",
        ")",
        {"4.6"},
    ),
    "patterns outlive the session": Mutant(
        "patterns.c", "    memset(d->patterns, 0, d->limits.pattern_memory * sizeof d->patterns[0]);\n",
        "",
        {"2.3"},
    ),
    "a pattern cannot be loaded again": Mutant(
        "patterns.c", "    if (piece->first != 0)\n        return PANS_DONE;\n",
        '    if (piece->first != 0)\n        return PANS_DONE;\n    if (known->whole != 0 && known->filled == known->whole)\n'
        '        return refuse(d, PANS_RANGE, "it is there");\n',
        {"5.1"},
    ),
    "steps that do not divide": Mutant(
        "walk.c", "if (steps == 0 || d->limits.dwell_steps % steps != 0)",
        "if (steps == 0 || steps > d->limits.dwell_steps)",
        {"11.4"},
    ),
    "a state too many": Mutant(
        "walk.c", "if (here->n_states > most)",
        "if (here->n_states > most + 1)",
        {"11.4"}, profile="dmd-spad",
    ),
    "walks that meet are too short": Mutant(
        "walk.c", "a->depth[next] <= depth)",
        "a->depth[next] < depth)",
        {"11.4"},
    ),
    "refused states stay": Mutant(
        "walk.c", "    forget_states(d);\n    if (longest",
        "    if (longest",
        {"11.4"},
    ),
    "SHOW beyond the run": Mutant(
        "walk.c", "d->run.cycles != 0 && show->exposure >=",
        "d->run.cycles == UINT64_MAX && show->exposure >=",
        {"11.7"},
    ),
    "a longer SHOW": Mutant(
        "walk.c", "if (count != 16)",
        "if (count < 16)",
        {"11.8"},
    ),
    "SHOW where the device follows": Mutant(
        "walk.c", "if (!d->run.active || !d->run.host_driven)",
        "if (!d->run.active)",
        {"11.8"},
    ),
    "a full list of gates is another status": Mutant(
        "gate.c", "return full ? refuse_number(d, PANS_RANGE,",
        "return full ? refuse_number(d, PANS_WRONG_STATE,",
        {"4.12"},
    ),
    "a longer GATE": Mutant(
        "gate.c", "if (count != 16)",
        "if (count < 16)",
        {"4.12"},
    ),
    "a gate at 2^62 and later": Mutant(
        "gate.c", "if (ticks == 0 || tick >= LAST_TICK)",
        "if (ticks == 0)",
        {"4.12"},
    ),
}  # fmt: skip

# Single changes that no rule names, and why.
UNNAMED = {
    "frames of half the length": (
        "permitted: payloads above 12 332 bytes may be dropped",
        Mutant(
            "frame.c", "    decoder->room = room;\n",
            "    decoder->room = room / 2;\n", set(),
        ),
    ),
    "arrival = departure": (
        "permitted: only a frame that is leaving parts the two",
        Mutant(
            "answers.c", "put64(body + HEADER_BYTES + 12, d->pong[0].arrival);",
            "put64(body + HEADER_BYTES + 12, d->tick);", set(),
        ),
    ),
    "states outlive the session": (
        "LOAD_PLAN forgets them, and without a plan none are used",
        Mutant(
            "device.c", "    forget_states(d);\n    d->ack =",
            "    d->ack =", set(),
        ),
    ),
    "names outlive the run": (
        "ARM forgets them too",
        Mutant(
            "run.c", "    d->run.active = false;\n    d->shows.count = 0;\n",
            "    d->run.active = false;\n", set(),
        ),
    ),
    "gates close at the end": (
        "gates are not on the link",
        Mutant(
            "run.c", "    if (reason != COMPLETED)\n        gates_close(d);",
            "    gates_close(d);", set(),
        ),
    ),
    "a block begun outlives the run": (
        "the end of a run closes it",
        Mutant(
            "stream.c", "    s->block.count = 0;\n",
            "", set(),
        ),
    ),
    "the click of the first exposure again": (
        "the hardware writes every byte of the word",
        Mutant(
            "edge.c", "    memset(word, 0, e->word_bytes);\n",
            "", set(),
        ),
    ),
    "patterns of several sizes": (
        "the projector refuses them too, when ARM asks it",
        Mutant(
            "patterns.c", "if (d->patterns[i].whole != d->patterns[0].whole)",
            "if (d->patterns[i].whole == 0)", set(),
        ),
    ),
    "no time to turn": (
        "permitted: the device knows how quick it is",
        Mutant(
            "walk.c", "&& closest >= d->limits.turn_ticks)",
            "&& closest != PANS_NEVER)", set(), profile="dmd-spad",
        ),
    ),
    "successors of states 256 and up change places": (
        "it tells the projector what may follow; the walk goes by the rows",
        Mutant(
            "walk.c", "    next[0] = row->next[0];\n    next[1] = row->next[1];",
            "    next[number > 255] = row->next[0];\n    next[number <= 255] = row->next[1];", set(),
        ),
    ),
}  # fmt: skip

SLOW = {  # one of their kind is tried in every run of the tests
    "a piece of a plan over an earlier one", "states over earlier ones", "words of 3 bytes", "reserved bytes of the header",
    "reserved bytes of CLICKS", "reserved bytes of WELCOME",
}  # fmt: skip
ALL = MISSED_ONCE | CHOSEN
FILES = ("answers", "device", "edge", "frame", "gate", "patterns", "plan", "run", "stream", "walk")


def test_the_changes_are_many_in_all_files_and_name_rules() -> None:
    assert len(ALL) == len(MISSED_ONCE) + len(CHOSEN)
    assert len(CHOSEN) >= 30
    assert all(mutant.rules and mutant.rules <= RULES.keys() for mutant in ALL.values())
    assert {mutant.file for mutant in CHOSEN.values()} >= {f"{name}.c" for name in FILES}
    assert MISSED_ONCE.keys() >= SLOW


@needs_compiler
@pytest.mark.parametrize(
    "fault", [pytest.param(one, marks=[pytest.mark.slow] * (one in SLOW or one in CHOSEN)) for one in ALL]
)
def test_a_single_change_is_named_by_its_rule(fault: str, tmp_path: Path) -> None:
    rules = ALL[fault].rules
    assert broken_by(ALL[fault], tmp_path, *rules) == rules


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("fault", UNNAMED)
def test_what_is_permitted_or_not_on_the_link_breaks_no_rule(fault: str, tmp_path: Path) -> None:
    assert broken_by(UNNAMED[fault][1], tmp_path) == set(), UNNAMED[fault][0]


class WithoutEnd(Instrument):
    """Renews a lease for as long as it is asked to."""

    def _renew(self, lease_ms: int) -> None:
        self._lease_tick = self._tick + lease_ms * self._tick_hz // 1000


def test_a_simulator_whose_lease_has_no_maximum_is_found() -> None:
    profile = load_profile("ideal")
    clock = DeviceClock(profile.clock.tick_hz)
    device = WithoutEnd(profile, open_scene("uniform"), power_on_tick=clock.tick_at(START_NS))
    found = tried("ideal", device, clock, "4.16", "4.23")
    assert {number for number, one in found.items() if one.verdict == "broken"} == {"4.23"}
