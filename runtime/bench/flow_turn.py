"""The row of objects in flow of `pans bench turn`: what a block of frames costs in the compiled turn, and in Python's.

Owns the made-up cells (seeded). Work is CPU time of this thread, from bytes to decisions with their passages; what a run does with them
afterwards is not in it. Decisions are compared with those of the core that takes its messages one by one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.core.plan import Plan
from pans.runtime.decide.backends import make_decider
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.make import make_flow_core
from pans.runtime.flow.settings import FlowSettings
from pans.runtime.flow.steps import FlowSteps
from pans.runtime.turn import rings as ring
from pans.runtime.turn.engine import Turn
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import NO_OBJECT, FrameBlock, encode_frames

from .rows import Row, cpu_times, per_item_ns
from .walks import SESSION

PERIOD_TICKS, BLOCK = 200, 125  # frames of 2 us at 100 MHz, a block every 250 us
EVERY, LENGTH = 500, 60  # frames from one cell to the next, and of its light: 1000 cells per second
LIGHT, DARK = 0.3, 1e-4  # chances of a click per channel and frame
READ_BLOCKS = 8


def flow_row(bundle: Bundle, quick: bool) -> Row:
    """Return the row of `bundle`, which has a table of single shots."""
    name = f"work per block of {BLOCK} frames in flow, {bundle.name}"
    if bundle.table is None:
        return {"name": name, "skipped": "the bundle has no table"}
    plan, n = _plan(bundle.n_features), 400 if quick else 4000
    reads = list(_reads(bundle.n_features, n))
    core, other = _core(bundle, plan), _core(bundle, plan)
    steps, decoder, plain = FlowSteps(core, plan), BulkDecoder(), BulkDecoder()
    turn = Turn(steps, decoder)

    def compiled() -> NDArray[np.void]:
        core.begin(0, 0)
        steps.begin(SESSION)
        rows = [np.zeros(0, DECISION_DTYPE)]
        for data in reads:
            ended = turn.feed([(1, data)])
            rows.append(turn.rows.copy())
            while ended != ring.ALL_TAKEN:
                ended = turn.feed_on()
                rows.append(turn.rows.copy())
        return np.concatenate(rows)

    def in_python() -> NDArray[np.void]:
        other.begin(0, 0)
        found = []
        for data in reads:
            spans, place = plain.take(data), 0
            while place < len(spans):
                taken, output = other.step_messages(Messages(plain.buffer, spans), place)
                found += output.decisions
                place += taken
        return np.array(found, DECISION_DTYPE)

    wanted, found = in_python(), compiled()
    numbered = [field for field in DECISION_DTYPE.names or () if field not in ("index", "object")]  # these go on
    differ = 100.0 if len(found) != len(wanted) else 100 * float((found[numbered] != wanted[numbered]).mean())
    ours, theirs = cpu_times([compiled, in_python])
    row: Row = {"name": name, "changed_percent": round(differ, 4)} | per_item_ns(ours, n)
    python_ns = round(theirs.least_s / n * 1e9, 3)
    return row | {"decisions": len(wanted), "python_ns": python_ns, "ns_per_frame": round(row["ns"] / BLOCK, 3)}


def _plan(n_features: int) -> Plan:
    places = np.arange(BLOCK)
    return Plan(
        mode="parallel",
        n_patterns=n_features,
        slot_offset_ticks=places * PERIOD_TICKS,
        slot_pattern=np.zeros(BLOCK, np.uint16),
        slot_shot=places.astype(np.uint16),
        exposure_ticks=PERIOD_TICKS,
        slot_period_ticks=PERIOD_TICKS,
        cycle_ticks=BLOCK * PERIOD_TICKS,
        shots_per_cycle=BLOCK,
        cycles_per_object=1,
        block_exposures=BLOCK,
        exposure_us=2.0,
    )


def _core(bundle: Bundle, plan: Plan) -> FlowCore:
    settings, decider = FlowSettings("cells", fields_per_s=10_000.0), make_decider(bundle, backend="table")
    core = make_flow_core(plan, decider, settings, bundle.classes, shots=1, dark_probability=DARK)
    core.warm_up()
    return core


def _reads(n_features: int, blocks: int) -> Iterator[bytes]:
    """Some blocks at a time, as they come at one read."""
    rng, n_bytes = np.random.default_rng(1), -(-n_features // 8)
    data: list[bytes] = []
    for block in range(blocks):
        first = block * BLOCK
        lit = (first + np.arange(BLOCK)) % EVERY < LENGTH
        clicks = rng.random((BLOCK, n_features)) < np.where(lit, LIGHT, DARK)[:, None]
        words = np.packbits(clicks, axis=1, bitorder="little")[:, :n_bytes]
        message = FrameBlock(block, 0, first * PERIOD_TICKS, first, PERIOD_TICKS, NO_OBJECT, words)
        data.append(encode_frames(message, SESSION))
        if len(data) == READ_BLOCKS or block == blocks - 1:
            yield b"".join(data)
            data.clear()
