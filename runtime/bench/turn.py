"""`pans bench turn`: what the compiled turn costs, beside the same in C, and its round trips beside the raw echo of the same bytes.

Owns the made-up streams (seeded), the rows and the processes at the other end. Work is CPU time of this thread, without the system's calls
for bytes; a round trip is wall time, from a decision to the next one and its record. Decisions are compared with the plain core's.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.bundle.walks import walk_nodes
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.link.base import Link, descriptor_of, open_link
from pans.runtime.live.drive import HostDriver, WalkPlace
from pans.runtime.turn import rings as ring
from pans.runtime.turn.engine import Limits, Turn
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.turn.system import now_ns, offered, read_now, wait_for, write_now
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.frame import unpack_body
from pans.runtime.wire.framing import FrameDecoder
from pans.runtime.wire.messages import (
    DARK_PATTERN,
    Ack,
    ClickBlock,
    Mark,
    Opcode,
    encode_ack,
    encode_clicks,
    encode_command,
    encode_mark,
)
from pans.runtime.wire.schema import SCHEMA

from . import ingest
from .flow_turn import flow_row
from .other_end import other_end
from .rows import BenchOptions, Row, cpu_times, per_item_ns, percentiles_us
from .turn_c import DEVICE, built, loop_in_c
from .walks import CLICK, SESSION, made_automaton, sequential_plan

Rows = NDArray[np.void]
READ_BYTES = 1 << 16
C_ROWS = 8192  # of the loop's ring
NS_PER_S = WAIT_NS = 1_000_000_000
ROUNDS = 5


def bench_turn(options: BenchOptions) -> list[Row]:
    """Return the rows of the work per block and per frame, still and in flow, then of round trips over a pseudo-terminal and TCP."""
    if why := offered():
        return [{"name": "turn", "skipped": why}]
    walking = made_automaton()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [
            _block_row(walking, folder, options.quick),
            _frame_row(load_bundle(options.first_bundle)[0], folder, options.quick),
            flow_row(load_bundle(options.first_bundle)[0], options.quick),
        ]
        return rows + _trips(walking, folder, options.quick)


# -- work ------------------------------------------------------------------------------------------------------------------


def _walk_plan(bundle: Bundle) -> tuple[Plan, Decider]:
    decider = make_decider(bundle)
    plan = sequential_plan(bundle, decider)
    lit = plan.slot_pattern != DARK_PATTERN
    n = int(lit.sum())
    return (
        replace(
            plan,
            slot_offset_ticks=np.arange(n) * 100,
            slot_pattern=plan.slot_pattern[lit],
            slot_shot=plan.slot_shot[lit],
            cycle_ticks=100 * n,
            block_exposures=1,
            drive="host",
        ),
        decider,
    )


def _single_exposures(plan: Plan, n_visits: int) -> list[bytes]:
    """A mark and a block for each exposure of each walk."""
    automaton, slots = plan.automaton, plan.slots_per_cycle
    assert automaton is not None
    clicks = (np.random.default_rng(1).random((n_visits, slots)) < CLICK).astype(np.uint8)
    states = walk_nodes(automaton, clicks)[:, :-1]
    frames, seq = [], 0
    for visit in range(n_visits):
        first = visit * slots
        frames.append(encode_mark(Mark(seq, visit, visit % 10, first, 100 * first, 3.0), SESSION))
        for slot in range(slots):
            facts = (seq + slot + 1, 0, 100 * (first + slot), first + slot, 100, visit)
            stamp, click = states[visit, slot : slot + 1].astype(np.uint16), clicks[visit, slot : slot + 1]
            frames.append(encode_clicks(ClickBlock(*facts, stamp, click), SESSION))
        seq += slots + 1
    return frames


def _by_core(plan: Plan, decider: Decider, frames: list[bytes]) -> Rows:
    core, decoder = Core(plan, decider, 1, 0), FrameDecoder()
    core.begin(0, 0)
    found = [one for data in frames for frame in decoder.feed(data) for one in core.step(frame).decisions]
    return np.array(found, DECISION_DTYPE)


def _fed(core: StreamCore, data: NDArray[np.uint8], keep: list[Rows] | None = None) -> None:
    list(core.begin(SESSION, 0, 0))
    for start in range(0, len(data), READ_BYTES):
        for batch in core.feed(data[start : start + READ_BYTES]):
            if keep is not None:
                keep.append(batch.rows.copy())


def _block_row(bundle: Bundle, folder: Path, quick: bool) -> Row:
    plan, decider = _walk_plan(bundle)
    frames = _single_exposures(plan, 100 if quick else 600)
    data, n = np.frombuffer(b"".join(frames), np.uint8), len(frames)
    wanted, found = _by_core(plan, decider, frames), list[Rows]()
    core = StreamCore(plan, decider, 1, 0, SESSION)
    _fed(core, data, found)
    row: Row = {
        "name": f"work per block of one exposure, {bundle.name}",
        "changed_percent": _differ(np.concatenate(found), wanted),
    }
    library = loop_in_c(folder)
    tables = core.tables
    c_rows, kept, steps = np.zeros(C_ROWS, DECISION_DTYPE), np.zeros(1 << 20, np.uint8), np.zeros(4096, np.int64)
    assert plan.automaton is not None
    successors, at = np.ascontiguousarray(plan.automaton.successors, np.uint32), np.arange(plan.slots_per_cycle)
    crcs = np.ascontiguousarray(tables.crc[0])

    def in_c() -> int:
        assert not isinstance(library, str)
        arrays: list[Any] = [successors, tables.labels, tables.probabilities, at, crcs, c_rows, kept, steps]
        a, b, c, d, e, f, g, h = map(_at, arrays)
        head = (_at(data), _n(len(data)), SESSION, SCHEMA, _n(plan.exposure_ticks))
        sizes = _n(len(at)), _n(crcs.shape[0])
        return int(library.walks(*head, a, _n(len(successors)), b, c, d, *sizes, e, int(tables.crc_zero[0]), f, g, h))

    return row | _beside(lambda: _fed(core, data), in_c, library, n, c_rows, wanted)


def _frame_row(bundle: Bundle, folder: Path, quick: bool) -> Row:
    if bundle.table is None:
        return {"name": f"work per parallel frame, {bundle.name}", "skipped": "the bundle has no table"}
    decider = make_decider(bundle, backend="table")
    plan = ingest.parallel_plan(bundle.n_features, 1)
    n_visits = 20 if quick else 120
    frames = list(ingest.visits(plan, 0, n_visits, 0))
    data, n = np.frombuffer(b"".join(frames), np.uint8), n_visits * plan.slots_per_cycle
    few = frames[: 4 * len(frames) // n_visits]
    wanted, found = _by_core(plan, decider, few), list[Rows]()
    _fed(StreamCore(plan, decider, 1, 0, SESSION), np.frombuffer(b"".join(few), np.uint8), found)
    row: Row = {
        "name": f"work per parallel frame, {bundle.name}, K = 1",
        "changed_percent": _differ(np.concatenate(found), wanted),
    }
    found.clear()
    core = StreamCore(plan, decider, 1, 0, SESSION)
    _fed(core, data, found)
    library = loop_in_c(folder)
    tables = core.tables
    c_rows, kept = np.zeros(C_ROWS, DECISION_DTYPE), np.zeros(1 << 20, np.uint8)
    lit = (plan.slot_pattern != DARK_PATTERN).astype(np.uint8)
    width = tables.word_rows.shape[0]

    def in_c() -> int:
        assert not isinstance(library, str)
        arrays: list[Any] = [tables.labels, tables.probabilities, tables.word_rows, tables.word_crc, lit, c_rows, kept]
        a, b, c, d, e, f, g = map(_at, arrays)
        head = (_at(data), _n(len(data)), SESSION, SCHEMA, _n(plan.exposure_ticks))
        return int(library.words(*head, a, b, c, d, int(tables.crc_zero[0]), e, _n(len(lit)), _n(width), f, g))

    return row | _beside(lambda: _fed(core, data), in_c, library, n, c_rows, np.concatenate(found))


def _beside(ours: Any, in_c: Any, library: Any, n: int, c_rows: Rows, wanted: Rows) -> Row:
    """The figures of both for `n` items, in turn; decisions of the loop in C are compared with `wanted`."""
    works = [ours] if isinstance(library, str) else [ours, in_c]
    spent = cpu_times(works)
    row = per_item_ns(spent[0], n)
    if isinstance(library, str):
        return row | {"c": library}
    decided = in_c()
    last = np.arange(max(decided - C_ROWS, 0), max(decided, 0))
    same = _differ(c_rows[last % C_ROWS], wanted[last]) if decided == len(wanted) else 100.0
    row |= {"c_ns": round(spent[1].least_s / n * 1e9, 3), "of_c": round(spent[0].least_s / spent[1].least_s, 3)}
    return row | {"c_changed_percent": same}


def _differ(found: Rows, wanted: Rows) -> float:
    """Percent of the decisions that are not as wanted, bit for bit; 100 when their number differs."""
    return 100.0 if len(found) != len(wanted) else round(100 * float((found != wanted).mean()), 4)


def _at(array: NDArray[Any]) -> Any:
    import ctypes

    return ctypes.c_void_p(array.ctypes.data)


def _n(number: int) -> Any:
    import ctypes

    return ctypes.c_int64(number)


# -- round trips -----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def echo(fd, out, wanted, times, scratch):  # type: ignore[no-untyped-def]
    """Send `out` uint8 (n,) and wait for `wanted` bytes, again and again; put the time of each into `times`; False when it ended early."""
    came = np.zeros(4096, np.uint8)
    for k in range(times.size):
        began, have = now_ns(scratch), 0
        if write_now(fd, out, 0, out.size) != out.size:
            return False
        while have < wanted:
            if wait_for(fd, WAIT_NS, False, scratch) <= 0:
                return False
            found = read_now(fd, came, 0, came.size)
            if found <= 0:
                return False
            have += found
        times[k] = now_ns(scratch) - began
    return True


def _trips(bundle: Bundle, folder: Path, quick: bool) -> list[Row]:
    device = built(DEVICE, "device", folder)
    if isinstance(device, str):
        return [{"name": "command to click block, decided and recorded", "skipped": device}]
    plan, decider = _walk_plan(bundle)
    n = 1000 if quick else 10_000
    return [_trip_row(_Trips(kind, plan, decider, device, n)) for kind in ("pty", "TCP", "pyusb")]


@dataclass(frozen=True, slots=True)
class _Trips:
    """`n` round trips each time, over a link of that kind."""

    kind: str
    plan: Plan
    decider: Decider
    device: Path
    n: int

    @contextmanager
    def other_end(self, mode: int, n_in: int, n_out: int) -> Iterator[Link]:
        """Start the device in `mode` and yield a link to it."""
        listen = "pty" if self.kind == "pty" else "tcp"
        facts = (mode, SESSION, SCHEMA, n_in, n_out, self.plan.slots_per_cycle)
        with other_end([str(self.device), listen, *map(str, facts)]) as url:
            usb = f"simusb:{url.removeprefix('serial:')}"
            with closing(open_link(usb if self.kind == "pyusb" else url)) as link:
                yield link


def _trip_row(trips: _Trips) -> Row:
    """Rounds of both, in turn."""
    framed, raw, changed = list[NDArray[np.int64]](), list[NDArray[np.int64]](), 0.0
    for _ in range(ROUNDS):
        times, command, answer, wrong = _framed(trips)
        framed.append(times)
        changed = max(changed, wrong)
        with trips.other_end(0, command, answer) as link:
            raw.append(_echoed(link, command, answer, trips.n)[trips.n // 10 :])
    ours, bare = (percentiles_us(np.concatenate(times)) for times in (framed, raw))
    row: Row = {"name": f"command to click block, decided and recorded, {trips.kind}, device in C", **ours}
    row |= {f"echo_{key}": value for key, value in bare.items() if key != "calls"}
    for key in ("p50", "p99"):
        row[f"{key}_of_echo"] = round(ours[f"{key}_us"] / bare[f"{key}_us"], 3)
    return row | {"command_bytes": command, "answer_bytes": answer, "changed_percent": changed}


def _echoed(link: Link, command: int, answer: int, n: int) -> NDArray[np.int64]:
    """Times of `n` raw echoes; by the link's own calls where it has no descriptor."""
    times, fd = np.zeros(n, np.int64), descriptor_of(link)
    if fd is not None:
        if not echo(fd, np.ones(command, np.uint8), answer, times, np.zeros(4, np.int64)):
            raise RuntimeError(f"the echo over {link.name} ended early")
        return times
    request = bytes([1]) * command
    for k in range(n):
        began, missing = link.now_ns(), answer
        link.write(request)
        while missing > 0:
            missing -= len(link.read(WAIT_NS / NS_PER_S))
        times[k] = link.now_ns() - began
    return times


def _framed(trips: _Trips) -> tuple[NDArray[np.int64], int, int, float]:
    """Times of round trips, without the first tenth, the bytes of a command and of its answer, and percent of wrong decisions."""
    plan, decider = trips.plan, trips.decider
    core = Core(plan, decider, 1, 0)
    core.warm_up()
    core.begin(0, 0)
    steps = core.bulk_steps(SESSION)
    assert steps is not None
    assert plan.automaton is not None
    driver = HostDriver(core, WalkPlace(plan, plan.automaton))
    turn = Turn(steps, BulkDecoder(), driver.arrays(SESSION))
    turn.warm_up()
    control = turn.control
    first = encode_command(1, Opcode.SHOW, driver.body(0, 0), SESSION)
    control[ring.DRIVES], control[ring.NEXT_ID], control[ring.OLDEST_ID] = 1, 2, 1
    control[ring.SENT_EXPOSURE], control[ring.SENT_STATE] = 0, 0
    times, bodies, rows = list[NDArray[np.int64]](), list[bytes](), list[Rows]()
    with trips.other_end(1, len(first), 0) as link:
        link.write(first)
        calls = _called if descriptor_of(link) is not None else _read_and_fed
        for found in calls(turn, link, trips.n):
            times.append(found)
            bodies += [turn.bytes_of(span) for span in turn.messages]
            rows.append(turn.rows.copy())
    again = Core(plan, decider, 1, 0)
    again.begin(0, 0)
    wanted = [one for body in bodies for one in again.step(unpack_body(body)).decisions]
    wrong = _differ(np.concatenate(rows), np.array(wanted, DECISION_DTYPE))
    found = np.concatenate(times)
    one = ClickBlock(1, 0, 100, 1, 100, 0, np.zeros(1, np.uint16), np.zeros(1, np.uint8))
    answer = len(encode_ack(Ack(1, 0, 0, ""), SESSION)) + len(encode_clicks(one, SESSION))
    return found[len(found) // 10 :], len(first), answer, wrong


def _called(turn: Turn, link: Link, n: int) -> Iterator[NDArray[np.int64]]:
    """Call again and again what reads and writes the descriptor itself, for `n` round trips; yield the times of those of each call."""
    done, fd = 0, descriptor_of(link)
    assert fd is not None
    while done < n:
        ended = turn.run(fd, Limits(due_ns=_soon()))
        if ended not in (ring.DUE, ring.FULL):
            raise RuntimeError(f"round trips over {link.name}: {ring.WHY[ended]} after {done}")
        left, blocks = turn.shows[:, ring.TIME], turn.blocks
        kept = blocks[1:, ring.RECORDED] - left[1 : len(blocks)]  # keeping a block, behind the command that answers it
        done += len(kept)
        yield np.diff(blocks[:, ring.DECIDED]) + kept


def _read_and_fed(turn: Turn, link: Link, n: int) -> Iterator[NDArray[np.int64]]:
    """Read, let the turn decide and send what it says, as a live run does where compiled code cannot read the link; `n` times.

    A time is from one decision to the next and to what is kept of it. What a live run settles then, it does while the answer is on its way.
    """
    decided_ns, done = 0, 0
    while done < n:
        data = link.read(WAIT_NS / NS_PER_S)
        ended = turn.feed([(link.now_ns(), data)])
        if ended == ring.BROKEN:
            link.write(turn.bytes_of(turn.shows[-1])[-turn.counts.unsent :])
        elif ended != ring.ALL_TAKEN or not data:
            raise RuntimeError(f"round trips over {link.name}: {ring.WHY[ended]} after {done}")
        blocks = turn.blocks
        if len(blocks):
            kept_ns = int(blocks[-1, ring.RECORDED])
            yield np.array([kept_ns - decided_ns] if decided_ns else [], np.int64)
            decided_ns, done = int(blocks[-1, ring.DECIDED]), done + 1


def _soon() -> int:
    return int(now_ns(np.zeros(4, np.int64))) + WAIT_NS
