"""Made-up streams of known content, seeded: of walks, of fixed patterns, of parallel frames and of objects in flow.

Bytes as a device sends them come out, and the decisions of a core that takes its messages one by one, with which faster ways are compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from pans.bundle.automaton import reachable_automaton, walk_nodes
from pans.bundle.backends import Decider
from pans.bundle.sensor import Bundle, Shown, make_bundle
from pans.decide import DECISION_DTYPE
from pans.decide.kernel import StreamCore
from pans.decide.plan import NO_SHOT, Plan
from pans.decide.still import Core
from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    DARK_PATTERN,
    NO_OBJECT,
    ClickBlock,
    FrameBlock,
    FrameDecoder,
    Mark,
    encode_clicks,
    encode_frames,
    encode_mark,
)

Rows = NDArray[np.void]
SESSION = 0x5EED
TICKS, TICK_HZ = 100, 1_000_000  # of one slot
READ_BYTES = 1 << 18  # what a link hands over at once
CLICK, DARK_CLICK, PARALLEL_CLICK = 0.15, 0.01, 0.4
SLOTS, WIDTH, CLASSES, PATTERNS, SIDE = 48, 256, 10, 1000, 28  # of the made-up automaton
DARK_FRAMES, VISIT_FRAMES, BLOCK_FRAMES = 2, 8190, 4096  # of each visit in parallel; frames in one message
FLOW_BLOCK, FLOW_TICKS = 125, 200  # frames of 2 us at 100 MHz, a block every 250 us
FLOW_EVERY, FLOW_LENGTH, FLOW_CLICK, FLOW_DARK = 500, 60, 0.3, 1e-4  # frames from cell to cell, and of its light


def made_automaton() -> Bundle:
    """Return a bundle with an automaton as large as those that are trained, its edges drawn at random; for speed alone."""
    rng = np.random.default_rng(1)
    starts = np.concatenate([[0], 1 + WIDTH * np.arange(SLOTS)])
    n_states = int(starts[-1])
    successors = np.empty((n_states, 2), np.int64)
    for slot in range(SLOTS):
        rows = slice(int(starts[slot]), int(starts[slot + 1]))
        low, high = (n_states, n_states + WIDTH) if slot == SLOTS - 1 else starts[slot + 1 : slot + 3]
        successors[rows] = rng.integers(low, high, (rows.stop - rows.start, 2))
    posteriors = rng.dirichlet(np.full(CLASSES, 0.3), n_states + WIDTH)
    pattern = rng.integers(0, PATTERNS, n_states)
    automaton = reachable_automaton(pattern, np.ones(n_states, np.int64), 1, successors, posteriors)
    levels = (rng.random((PATTERNS, SIDE * SIDE)) < 0.05).astype(np.int64)
    return make_bundle(
        name=f"made-up automaton of {automaton.n_states} states",
        task="speed",
        classes=[str(number) for number in range(CLASSES)],
        image_shape=(SIDE, SIDE),
        optics=Shown(2, levels, 0.02),
        automaton=automaton,
        provenance={},
    )


def sequential_plan(bundle: Bundle, decider: Decider, *, host: bool = False) -> Plan:
    """Return one dark slot and all patterns, or the longest walk, in each cycle; one cycle per object.

    With `host` the host drives the walk: there is no dark slot, and a block for each exposure.
    """
    automaton = decider.automaton
    lit = np.arange(bundle.n_features) if automaton is None else np.full(automaton.n_slots, ADAPTIVE_PATTERN)
    pattern = (lit if host else np.concatenate([[DARK_PATTERN], lit])).astype(np.uint16)
    shot = np.where(pattern == DARK_PATTERN, NO_SHOT, 0).astype(np.uint16)
    n, drive = len(pattern), "" if automaton is None else "host" if host else "device"
    times = (90, TICKS, TICKS * n, 1, 1, 1 if host else n, 90 * 1e6 / TICK_HZ)
    return Plan("sequential", len(bundle.pattern_levels), np.arange(n) * TICKS, pattern, shot, *times, automaton, drive)


def visits(plan: Plan, n_visits: int) -> Iterator[bytes]:
    """Yield a mark and then blocks of `plan.block_exposures` for each object; clicks with fixed probabilities."""
    rng = np.random.default_rng(n_visits)
    slots, lit, size = plan.slots_per_cycle, plan.slot_pattern != DARK_PATTERN, plan.block_exposures
    clicks = (rng.random((n_visits, slots)) < np.where(lit, CLICK, DARK_CLICK)).astype(np.uint8)
    stamps = np.tile(plan.slot_pattern, (n_visits, 1))
    if plan.automaton is not None:
        nodes = walk_nodes(plan.automaton, clicks[:, lit])[:, :-1]
        stamps[:, lit] = np.where(nodes < plan.automaton.n_states, nodes, DARK_PATTERN)
    seq = 0
    for visit in range(n_visits):
        first = visit * slots
        yield encode_mark(Mark(seq, visit, visit % 10, first, TICKS * first, 3.0), SESSION)
        for slot in range(0, slots, size):
            seq, part = seq + 1, slice(slot, slot + size)
            facts = (seq, 0, TICKS * (first + slot), first + slot, TICKS, visit)
            yield encode_clicks(ClickBlock(*facts, stamps[visit, part], clicks[visit, part]), SESSION)
        seq += 1


def parallel_plan(n_patterns: int, shots: int) -> Plan:
    """Return visits of DARK_FRAMES dark frames and about VISIT_FRAMES of light, a whole number of windows."""
    frames = VISIT_FRAMES // shots * shots
    pattern = np.concatenate([np.full(DARK_FRAMES, DARK_PATTERN), np.zeros(frames)]).astype(np.uint16)
    shot = np.concatenate([np.full(DARK_FRAMES, NO_SHOT), np.arange(frames)]).astype(np.uint16)
    n = len(pattern)
    times = (90, TICKS, TICKS * n, frames, 1, BLOCK_FRAMES, 9.0)
    return Plan("parallel", n_patterns, np.arange(n) * TICKS, pattern, shot, *times)


def parallel_visits(plan: Plan, n_visits: int) -> Iterator[bytes]:
    """Yield the frames of consecutive visits, each with its mark; clicks with fixed probabilities."""
    rng, seq, slots = np.random.default_rng(0), 0, plan.slots_per_cycle
    rate = np.where(plan.slot_pattern == DARK_PATTERN, DARK_CLICK, PARALLEL_CLICK)[:, None]
    for visit in range(n_visits):
        start = visit * slots
        yield encode_mark(Mark(seq, visit, visit % 10, start, visit * plan.cycle_ticks, 3.0), SESSION)
        words = packed_words(rng.random((slots, plan.n_patterns)) < rate)
        for slot in range(0, slots, BLOCK_FRAMES):
            seq += 1
            facts = (seq, 0, TICKS * (start + slot), start + slot, TICKS, visit)
            yield encode_frames(FrameBlock(*facts, words[slot : slot + BLOCK_FRAMES]), SESSION)
        seq += 1


def packed_words(clicks: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return clicks (n, channels) as the wire has them: words of 1, 2 or whole 8 bytes."""
    channels = clicks.shape[1]
    width = 1 if channels <= 8 else 2 if channels <= 16 else 8 * -(-channels // 64)
    packed = np.packbits(clicks, axis=1, bitorder="little")
    return np.pad(packed, ((0, 0), (0, width - packed.shape[1])))


def flow_plan(n_patterns: int) -> Plan:
    """Return frames of light without a pause, FLOW_BLOCK in a message."""
    places = np.arange(FLOW_BLOCK)
    times = (FLOW_TICKS, FLOW_TICKS, FLOW_BLOCK * FLOW_TICKS, FLOW_BLOCK, 1, FLOW_BLOCK, 2.0)
    dark = np.zeros(FLOW_BLOCK, np.uint16)
    return Plan("parallel", n_patterns, places * FLOW_TICKS, dark, places.astype(np.uint16), *times)


def flow_blocks(n_patterns: int, blocks: int) -> Iterator[bytes]:
    """Yield messages with a cell every FLOW_EVERY frames."""
    rng = np.random.default_rng(1)
    for block in range(blocks):
        first = block * FLOW_BLOCK
        lit = (first + np.arange(FLOW_BLOCK)) % FLOW_EVERY < FLOW_LENGTH
        clicks = rng.random((FLOW_BLOCK, n_patterns)) < np.where(lit, FLOW_CLICK, FLOW_DARK)[:, None]
        facts = (block, 0, first * FLOW_TICKS, first, FLOW_TICKS, NO_OBJECT)
        yield encode_frames(FrameBlock(*facts, packed_words(clicks)), SESSION)


def reads_of(data: bytes, size: int = READ_BYTES) -> list[NDArray[np.uint8]]:
    """Return `data` in pieces as a link hands them over."""
    whole = np.frombuffer(data, np.uint8)
    return [whole[start : start + size] for start in range(0, len(whole), size)]


def decided_one_by_one(plan: Plan, decider: Decider, frames: Iterable[bytes]) -> Rows:
    """Return the decisions of the core that takes its messages one by one, DECISION_DTYPE (n,)."""
    core, decoder = Core(plan, decider, 1, 0), FrameDecoder()
    core.begin(0, 0)
    found = [one for data in frames for frame in decoder.feed(data) for one in core.step(frame).decisions]
    return np.array(found, DECISION_DTYPE)


def decided_in_stream(core: StreamCore, reads: Iterable[NDArray[np.uint8]], keep: list[Rows] | None = None) -> None:
    """Give all of a stream to the compiled steps, from its beginning; append copies of the decisions to `keep`."""
    list(core.begin(SESSION, 0, 0))
    for data in reads:
        for batch in core.feed(data):
            if keep is not None:
                keep.append(batch.rows.copy())


def percent_changed(found: list[Rows], wanted: Rows) -> float:
    """Return the percentage of decisions that are not as wanted, bit for bit; 100 when their number differs."""
    rows = np.concatenate([wanted[:0], *found])
    return 100.0 if len(rows) != len(wanted) else round(100 * float((rows != wanted).mean()), 4)
