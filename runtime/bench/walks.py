"""`pans bench`: walks of automata and sequential streams: decisions, compiled steps, the live core's steps, replays of recordings.

Owns the made-up streams (seeded, of known content) and the rows. Every speed stands beside a check against a slower way to the same: leaves
against the plain walk of bundle/walks.py, rows and replays against `Core.step`, message by message.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton, reachable_automaton
from pans.runtime.bundle.model import Bundle, Shown, bundle_bytes, make_bundle
from pans.runtime.bundle.walks import log_scores, walk_nodes
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.core.plan import ADAPTIVE_PATTERN, NO_SHOT, Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.automaton import AutomatonDecider
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import UsageError
from pans.runtime.record import Recorder, read_recording, replay
from pans.runtime.record.parted_recorder import repeated_setup
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.commands import Arm
from pans.runtime.wire.frame import Messages, pack_body
from pans.runtime.wire.framing import FrameDecoder
from pans.runtime.wire.messages import DARK_PATTERN, ClickBlock, Mark, encode_clicks, encode_mark

from .rows import Row, cpu_time, latencies_us, per_item_ns, percentiles_us

SESSION = 0x5EED
CLICK, DARK_CLICK = 0.15, 0.01  # about what walks of trained automata and dark slots give
SLOTS, WIDTH, CLASSES, PATTERNS = 48, 256, 10, 1000  # of the made-up automaton
SIDE, LIT_SHARE, LIT_PHOTONS = (
    28,
    0.05,
    0.02,
)  # pixels of its patterns; which share is lit, with how many photoelectrons
TICK_HZ = 1_000_000
READ_BYTES = 1 << 18
WORDS = 20_000
CALLS = 5_000


def made_automaton() -> Bundle:
    """A bundle with an automaton as large as those that are trained, its edges drawn at random; for speed alone."""
    rng = np.random.default_rng(1)
    starts = np.concatenate([[0], 1 + WIDTH * np.arange(SLOTS)])
    n_states, n_leaves = int(starts[-1]), WIDTH
    successors = np.empty((n_states, 2), np.int64)
    for slot in range(SLOTS):
        rows = slice(int(starts[slot]), int(starts[slot + 1]))
        low, high = (n_states, n_states + n_leaves) if slot == SLOTS - 1 else starts[slot + 1 : slot + 3]
        successors[rows] = rng.integers(low, high, (rows.stop - rows.start, 2))
    posteriors = rng.dirichlet(np.full(CLASSES, 0.3), n_states + n_leaves)
    pattern = rng.integers(0, PATTERNS, n_states)
    automaton = reachable_automaton(pattern, np.ones(n_states, np.int64), 1, successors, posteriors)
    shown = Shown(2, (rng.random((PATTERNS, SIDE * SIDE)) < LIT_SHARE).astype(np.int64), LIT_PHOTONS)
    names = [str(number) for number in range(CLASSES)]
    return make_bundle(
        name=f"made-up automaton of {automaton.n_states} states", task="speed", classes=names, image_shape=(SIDE, SIDE), optics=shown,
        automaton=automaton, provenance={},
    )  # fmt: skip


def decide_rows(bundle: Bundle, quick: bool) -> list[Row]:
    """Decisions on whole click words: time per decision and per exposure, against the plain walk."""
    decider = AutomatonDecider(bundle)
    automaton = decider.automaton
    words = (np.random.default_rng(1).random((WORDS // 10 if quick else WORDS, automaton.n_bits)) < CLICK).astype(
        np.int64
    )
    spent = cpu_time(lambda: decider.decide_batch(words, 1))
    leaves, exposures = decider.leaves(words)
    nodes = walk_nodes(automaton, words)[:, -1]
    wanted = log_scores(automaton.posteriors[nodes])
    row: Row = {"name": f"{bundle.name} {decider.name}", **per_item_ns(spent, len(words))}
    row["ns_per_exposure"] = round(spent.least_s / int(exposures.sum()) * 1e9, 3)
    row |= latencies_us(lambda one: decider.decide(one, 1), list(words[:CALLS]))
    row["score_error"] = float(np.abs(decider.scores_batch(words, 1) - wanted).max())
    row["changed_percent"] = round(100 * float((leaves + automaton.n_states != nodes).mean()), 4)
    return [row | {"exposures_mean": round(float(exposures.mean()), 2), "checksum": int(leaves.sum(dtype=np.int64))}]


def stream_rows(bundle: Bundle, quick: bool) -> list[Row]:
    """Sequential streams of `bundle`: compiled steps, the live core's steps, and the replay of a recording."""
    try:
        decider = make_decider(bundle, backend="auto" if bundle.table is None else "table")
    except UsageError as error:
        return [{"name": f"sequential, {bundle.name}", "skipped": str(error)}]
    plan = sequential_plan(bundle, decider)
    n_visits = 1_000 if quick else 20_000
    frames = list(visits(plan, n_visits))
    wanted = _by_core(plan, decider, frames)
    name = f"{bundle.name}, {decider.name}"
    exposures = n_visits * plan.slots_per_cycle
    return [
        {"name": f"wire to decisions, sequential, {name}", **_bulk_row(plan, decider, frames, exposures, wanted)},
        {"name": f"one step of the live core, sequential, {name}", **_step_row(plan, decider, frames, wanted)},
        {"name": f"replay, sequential, {name}", **_replay_row(bundle, plan, decider, frames, exposures, wanted)},
    ]


def sequential_plan(bundle: Bundle, decider: Decider) -> Plan:
    """One dark slot and all patterns, or the longest walk, in each cycle; one cycle per object."""
    automaton: Automaton | None = getattr(decider, "automaton", None)
    lit = np.arange(bundle.n_features) if automaton is None else np.full(automaton.n_slots, ADAPTIVE_PATTERN)
    pattern = np.concatenate([[DARK_PATTERN], lit]).astype(np.uint16)
    shot = np.where(pattern == DARK_PATTERN, NO_SHOT, 0).astype(np.uint16)
    n, drive = len(pattern), "" if automaton is None else "device"
    times = (90, 100, 100 * n, 1, 1, n, 90 * 1e6 / TICK_HZ)
    return Plan("sequential", len(bundle.pattern_levels), np.arange(n) * 100, pattern, shot, *times, automaton, drive)


def visits(plan: Plan, n_visits: int) -> Iterator[bytes]:
    """Frames on the wire: a mark and one block for each object; clicks with fixed probabilities, seeded."""
    rng = np.random.default_rng(n_visits)
    slots, lit = plan.slots_per_cycle, plan.slot_pattern != DARK_PATTERN
    clicks = (rng.random((n_visits, slots)) < np.where(lit, CLICK, DARK_CLICK)).astype(np.uint8)
    stamps = np.tile(plan.slot_pattern, (n_visits, 1))
    if plan.automaton is not None:
        nodes = walk_nodes(plan.automaton, clicks[:, lit])[:, :-1]
        stamps[:, lit] = np.where(nodes < plan.automaton.n_states, nodes, DARK_PATTERN)
    for visit in range(n_visits):
        first, tick = visit * slots, visit * plan.cycle_ticks
        yield encode_mark(Mark(2 * visit, visit, visit % 10, first, tick, 3.0), SESSION)
        facts = (2 * visit + 1, 0, tick, first, plan.slot_period_ticks, visit)
        yield encode_clicks(ClickBlock(*facts, stamps[visit], clicks[visit]), SESSION)


def _by_core(plan: Plan, decider: Decider, frames: list[bytes]) -> NDArray[np.void]:
    """The decisions of the plain core, message by message: what every faster way must give."""
    core, decoder = Core(plan, decider, 1, 0), FrameDecoder()
    core.begin(0, 0)
    decisions = [one for data in frames for frame in decoder.feed(data) for one in core.step(frame).decisions]
    return np.array(decisions, DECISION_DTYPE)


def _differ(found: list[NDArray[np.void]], wanted: NDArray[np.void]) -> float:
    """Percent of the decisions that are not the plain core's, bit for bit; 100 when their number differs."""
    rows = np.concatenate(found)
    return 100.0 if len(rows) != len(wanted) else round(100 * float((rows != wanted).mean()), 4)


def _bulk_row(plan: Plan, decider: Decider, frames: list[bytes], exposures: int, wanted: NDArray[np.void]) -> Row:
    data = np.frombuffer(b"".join(frames), np.uint8)

    def run(keep: list[NDArray[np.void]] | None = None) -> None:
        core = StreamCore(plan, decider, 1, 0, SESSION)
        for start in range(0, len(data), READ_BYTES):
            for batch in core.feed(data[start : start + READ_BYTES]):
                if keep is not None:
                    keep.append(batch.rows.copy())

    found: list[NDArray[np.void]] = []
    run(found)
    return _rates(cpu_time(run, 5), exposures, len(wanted)) | {"changed_percent": _differ(found, wanted)}


def _rates(spent: Any, exposures: int, decisions: int) -> Row:
    return {
        "rate": round(exposures / spent.least_s),
        "rate_median": round(exposures / spent.median_s),
        "ns_per_exposure": round(spent.least_s / exposures * 1e9, 3),
        "decisions_s": round(decisions / spent.least_s),
        "exposures": exposures,
        "runs": spent.runs,
    }


def _step_row(plan: Plan, decider: Decider, frames: list[bytes], wanted: NDArray[np.void]) -> Row:
    """A whole object's block at a time through `Core.step_messages`, as the live loop calls it; wall time of each call."""
    core, decoder = Core(plan, decider, 1, 0), BulkDecoder()
    core.warm_up()
    core.warm_up_steps()
    core.begin(0, 0)
    times: list[int] = []
    found: list[Any] = []
    for data in frames:
        messages = Messages(decoder.buffer, decoder.take(data)).kept()
        start = time.perf_counter_ns()
        _, output = core.step_messages(messages, 0)
        spent = time.perf_counter_ns() - start
        if output.decisions:
            times.append(spent)
            found += output.decisions
    row = percentiles_us(np.array(times, np.int64))
    per_exposure = 1000 * row["p50_us"] / plan.slots_per_cycle
    changed = _differ([np.array(found, DECISION_DTYPE)], wanted)
    return row | {"ns_per_exposure": round(per_exposure, 1), "changed_percent": changed}


def _replay_row(
    bundle: Bundle, plan: Plan, decider: Decider, frames: list[bytes], exposures: int, wanted: NDArray[np.void]
) -> Row:
    """`pans replay` of a recording of the stream, whose decisions the plain core has made."""
    drive = {} if plan.automaton is None else {"drive": plan.drive, "confidence": 0.0}
    config = {"shots": 1, "tick_hz": TICK_HZ, "backend": decider.name, **drive}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.pansrec"
        with Recorder(path, {"simulated": True, "config": config}, bundle=bundle_bytes(bundle)) as recorder:
            for command in repeated_setup(plan, Arm(0, 0, 1000), SESSION):
                recorder.add_command(0, command)
            decoder = FrameDecoder()
            for data in frames:
                recorder.add_message(0, pack_body(decoder.feed(data)[0]))
            recorder.add_decisions(wanted)
            recorder.close({})
        recording = read_recording(path)
        spent = cpu_time(lambda: replay(recording, bundle), 5)
        found = replay(recording, bundle)
        row = _rates(spent, exposures, found.decisions) | {"bytes": recording.size}
    return row | {"changed_percent": 0.0 if found.as_recorded else 100.0}
