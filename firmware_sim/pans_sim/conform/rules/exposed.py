"""Rules of section 15: when exposures happened, as the device tells."""

from __future__ import annotations

import math
from typing import Any

from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import (
    EXPOSED_SCHEMA,
    DeviceState,
    Exposed,
    MessageType,
    Opcode,
    Status,
    announced,
    announces_exposed,
    encode_command,
    pack_command,
)
from pans_sim.conform.bench import LEASE_MS, PATIENCE_S, STEP_S, Bench
from pans_sim.conform.plans import Layout
from pans_sim.conform.registry import NotTried, Silent, need, rule

from .automata import SLOTS, four_states
from .runs import blocks_of, lateness

LONG_S, SHORT_S = 1.2, 0.1  # of a run in which a STATUS comes between its beginning and its end, and of another
UNDER_WAY = 2  # exposures that have begun, and may not have ended, when STATUS is sent


def ran(bench: Bench, layout: Layout, seconds: float, *, stops: bool = False) -> tuple[int, list[Any], list[Any]]:
    """Run what is loaded for so long, to its end or to a STOP; return the start tick, the stream and all other messages, in order."""
    bench.inbox.clear()
    bench.grant()
    start = bench.arm(0 if stops else math.ceil(seconds / layout.seconds(1)))

    def over() -> bool:
        told = (one.message for one in bench.inbox if one.kind == MessageType.STATUS)
        return any(status.state == DeviceState.IDLE and status.tick >= start for status in told)

    stop_ns = bench.link.now_ns() + round(seconds * 1e9)
    end_ns = stop_ns + round(PATIENCE_S * 1e9)
    while not over():
        if bench.link.now_ns() >= end_ns:
            raise Silent(f"a run of {seconds:.2f} s has not ended after {seconds + PATIENCE_S:.2f} s")
        bench.grant(lease_ms=LEASE_MS)
        if stops and bench.link.now_ns() >= stop_ns:
            bench.last_id, stops = bench.last_id + 1, False
            bench.send(encode_command(bench.last_id, Opcode.STOP, b"", bench.session))
        bench.listen(0.2, over)
    bench.listen(STEP_S)
    others = [one.message for one in bench.inbox if one.kind not in STREAM_TYPES]
    return start, bench.stream(), others


@rule(
    "15.1",
    "A device that announces when exposures happened tells of each exposure once, in EXPOSED directly before STATUS, and of equal errors "
    "names the first; one that does not sends none.",
)
def told_once(bench: Bench) -> None:
    schema = bench.facts.get("exposed_schema", EXPOSED_SCHEMA)
    need(schema == EXPOSED_SCHEMA, f"exposed_schema is {schema:#010x}, expected {EXPOSED_SCHEMA:#010x}")
    layout = bench.layout()
    bench.upload(layout)
    for stops in (False, True):
        start, _, others = ran(bench, layout, LONG_S, stops=stops)  # the bench takes no EXPOSED that was not announced
        if "exposed_schema" in bench.facts:
            _hold(others, start)


def _hold(others: list[Any], start: int) -> None:
    """Hold the EXPOSED of one run against the STATUS behind each of them, and its numbers against each other."""
    told = 0
    for one, behind in zip(others, [*others[1:], None]):
        if isinstance(one, Exposed):
            need(isinstance(behind, Status), "EXPOSED without STATUS behind it")
            numbers, first, told = one[3:], told, told + one.exposures
            words = f"EXPOSED of the exposures {first} to {told - 1} names {numbers[0]} and {numbers[1]}"
            need(all(first <= number < told for number in numbers), words)
            for error, number in zip((one.start_error, one.length_error), numbers):
                need(error != 0 or number == first, f"{words}, where all are on the tick")
        elif isinstance(one, Status) and one.tick >= start:
            least = one.next_exposure - (UNDER_WAY if one.state == DeviceState.RUNNING else 0)
            words = f"EXPOSED has told of {told} exposures before a STATUS that says {one.next_exposure}"
            need(least <= told <= one.next_exposure, words)


@rule(
    "15.2",
    "Start and length of every exposure are off by the profile's tolerance at most, and no block is stamped later than EXPOSED says.",
)
def in_time(bench: Bench) -> None:
    if not announces_exposed(bench.facts):
        raise NotTried("the device does not tell when exposures happened")
    extension = announced(bench.facts)
    follows = extension is not None and extension.states >= 4
    plans: list[dict[str, Any]] = [{}, {"longer": 0.5}, *([{"adaptive": SLOTS}] if follows else [])]
    for words in plans:
        layout = bench.layout(**words)
        bench.upload(layout)
        if "adaptive" in words and extension is not None:
            bench.done(Opcode.LOAD_STATES, pack_command(four_states(extension.dwell_steps)))
        start, stream, others = ran(bench, layout, SHORT_S)
        told = [one for one in others if isinstance(one, Exposed)]
        need(bool(told), "a whole run brought no EXPOSED")
        allowed = (
            bench.profile.exposure_tolerance_us(layout.exposure_ticks * 1e6 / layout.tick_hz) * layout.tick_hz / 1e6
        )
        for what, errors in (
            ("start", {one.start_exposure: one.start_error for one in told}),
            ("length", {one.length_exposure: one.length_error for one in told}),
        ):
            for number, error in errors.items():
                need(
                    abs(error) <= allowed,
                    f"the {what} of exposure {number} is off by {error} ticks, allowed {allowed:.4g}",
                )
        late, worst = (
            max(lateness(layout, start, one) for one in blocks_of(stream)),
            max(abs(one.start_error) for one in told),
        )
        need(late <= worst, f"a block is stamped {late} ticks late, EXPOSED says at most {worst}")
