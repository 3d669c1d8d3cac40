"""`pans bench turn` and `pans bench link`: the work of the kernel per block, and round trips beside the raw echo of the same bytes.

Work is CPU time of this thread, without the system's calls for bytes. A round trip is wall time, from a decision to the next one and its
record; the other end is a device in C (device.c) in a process of its own. Decisions are compared with those made one by one.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import LinkError
from pans.base.machine import njit
from pans.bundle.backends import Decider, make_decider
from pans.bundle.sensor import Bundle, load_bundle
from pans.decide import DECISION_DTYPE
from pans.decide.flow import FlowCore, FlowSettings, make_flow_core
from pans.decide.kernel import Kernel, Limits, StreamCore, now_ns, offered, read_now, wait_for, write_now
from pans.decide.kernel import arrays as ring
from pans.decide.plan import Plan
from pans.decide.still import Core
from pans.live.loop import HostDriver, WalkPlace
from pans.protocol.links import Link, descriptor_of, open_link
from pans.protocol.wire import (
    SCHEMA,
    Ack,
    ClickBlock,
    FrameDecoder,
    Opcode,
    encode_ack,
    encode_clicks,
    encode_command,
    unpack_body,
)

from . import streams
from .rows import BenchOptions, Row, cpu_time, per_item_ns, percentiles_us
from .streams import Rows

NS_PER_S = WAIT_NS = 1_000_000_000
PATIENCE_S = 20.0
READ_BYTES = 1 << 16
ROUNDS = 5
KINDS = ("pty", "TCP", "pyusb")
FLOW_READ_BLOCKS = 8


def bench_turn(options: BenchOptions) -> list[Row]:
    """Return the rows of the work per block and per frame, still and in flow, then of round trips over each link."""
    if why := offered():
        return [{"name": "turn", "skipped": why}]
    bundle, _ = load_bundle(options.first_bundle)
    rows = [block_row(streams.made_automaton(), options.quick)]
    if bundle.table is None:
        rows.append({"name": f"work per parallel frame, {bundle.name}", "skipped": "the bundle has no table"})
    else:
        rows += [frame_row(bundle, options.quick), flow_row(bundle, options.quick)]
    return rows + bench_link(options)


def bench_link(options: BenchOptions) -> list[Row]:
    """Return a row for each link: the round trip from a command to the decided and recorded click block, the raw echo beside it."""
    if why := offered():
        return [{"name": "link", "skipped": why}]
    with tempfile.TemporaryDirectory() as folder:
        device = built_device(Path(folder))
        if isinstance(device, str):
            return [{"name": "command to click block, decided and recorded", "skipped": device}]
        bundle = streams.made_automaton()
        decider = make_decider(bundle)
        plan, n = streams.sequential_plan(bundle, decider, host=True), 1000 if options.quick else 10_000
        return [trip_row(Trips(kind, plan, decider, device, n)) for kind in KINDS]


def built_device(folder: Path) -> Path | str:
    """Compile device.c into `folder` with the system's C compiler; a word of explanation where that is not possible."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return "no C compiler (gcc or cc) on this machine"
    source, made = Path(__file__).with_name("device.c"), folder / "device"
    done = subprocess.run([compiler, "-O3", "-o", str(made), str(source)], capture_output=True, text=True)
    return f"{compiler} failed: {done.stderr.strip().splitlines()[-1:]}" if done.returncode else made


def block_row(bundle: Bundle, quick: bool) -> Row:
    """Return the row of a walk driven by the host, a mark and a block for each exposure."""
    decider = make_decider(bundle)
    plan = streams.sequential_plan(bundle, decider, host=True)
    frames = list(streams.visits(plan, 100 if quick else 600))
    core, name = StreamCore(plan, decider, 1, 0, streams.SESSION), f"work per block of one exposure, {bundle.name}"
    return _work_row(name, core, frames, len(frames), streams.decided_one_by_one(plan, decider, frames))


def frame_row(bundle: Bundle, quick: bool) -> Row:
    """Return the row of parallel frames, which a table decides."""
    decider, plan = make_decider(bundle, backend="table"), streams.parallel_plan(bundle.n_features, 1)
    n_visits = 20 if quick else 120
    frames = list(streams.parallel_visits(plan, n_visits))
    few = frames[: 4 * len(frames) // n_visits]
    core, name = StreamCore(plan, decider, 1, 0, streams.SESSION), f"work per parallel frame, {bundle.name}, K = 1"
    wanted = streams.decided_one_by_one(plan, decider, few)
    return _work_row(name, core, frames, n_visits * plan.slots_per_cycle, wanted)


def _work_row(name: str, core: StreamCore, frames: list[bytes], n: int, wanted: Rows) -> Row:
    """The work of all `frames`, which hold `n` items; the first decisions are compared with `wanted`."""
    reads, found = streams.reads_of(b"".join(frames), READ_BYTES), list[Rows]()
    streams.decided_in_stream(core, reads, found)
    changed = streams.percent_changed([np.concatenate(found)[: len(wanted)]], wanted)
    spent = cpu_time(lambda: streams.decided_in_stream(core, reads))
    return {"name": name, "changed_percent": changed} | per_item_ns(spent, n)


def flow_row(bundle: Bundle, quick: bool) -> Row:
    """Return the row of objects in flow, from bytes to decisions with their passages."""
    plan, n = streams.flow_plan(bundle.n_features), 400 if quick else 4000
    blocks = list(streams.flow_blocks(bundle.n_features, n))
    reads = [b"".join(blocks[first : first + FLOW_READ_BLOCKS]) for first in range(0, n, FLOW_READ_BLOCKS)]
    core, plain, decoder = _flow_core(bundle, plan), _flow_core(bundle, plan), FrameDecoder()
    plain.begin(0, 0)
    decided = (one for data in reads for frame in decoder.feed(data) for one in plain.step(frame).decisions)
    wanted = np.array([*decided], DECISION_DTYPE)
    turn = Kernel(core.steps(streams.SESSION), FrameDecoder())

    def compiled() -> Rows:
        core.begin(0, 0)
        core.steps(streams.SESSION)
        rows = [wanted[:0]]
        for data in reads:
            ended = turn.feed([(1, data)])
            rows.append(turn.rows.copy())
            while ended != ring.ALL_TAKEN:
                ended = turn.feed_on()
                rows.append(turn.rows.copy())
        return np.concatenate(rows)

    found = compiled()
    row: Row = {"name": f"work per block of {streams.FLOW_BLOCK} frames in flow, {bundle.name}"}
    row |= {"changed_percent": streams.percent_changed([found], wanted), **per_item_ns(cpu_time(compiled), n)}
    return row | {"decisions": len(wanted), "ns_per_frame": round(row["ns"] / streams.FLOW_BLOCK, 3)}


def _flow_core(bundle: Bundle, plan: Plan) -> FlowCore:
    settings, decider = FlowSettings("cells", fields_per_s=10_000.0), make_decider(bundle, backend="table")
    core = make_flow_core(plan, decider, settings, bundle.classes, shots=1, dark_probability=streams.FLOW_DARK)
    core.warm_up()
    return core


@dataclass(frozen=True, slots=True)
class Trips:
    """`n` round trips each time, over a link of that kind, with the compiled device."""

    kind: str
    plan: Plan
    decider: Decider
    device: Path
    n: int

    @contextmanager
    def other_end(self, mode: int, n_in: int, n_out: int) -> Iterator[Link]:
        """Start the device in `mode` and yield a link to it."""
        facts = (mode, streams.SESSION, SCHEMA, n_in, n_out, self.plan.slots_per_cycle)
        words = [str(self.device), "pty" if self.kind == "pty" else "tcp", *map(str, facts)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            url = child.stdout.readline().strip()
            try:
                if not url:
                    raise LinkError("the device in C did not start")
                usb = f"simusb:{url.removeprefix('serial:')}"
                with closing(open_link(usb if self.kind == "pyusb" else url)) as link:
                    yield link
            finally:
                child.terminate()
                child.wait(PATIENCE_S)


def trip_row(trips: Trips) -> Row:
    """Return the row of one link: round trips and raw echoes in turn."""
    framed, raw, changed = list[NDArray[np.int64]](), list[NDArray[np.int64]](), 0.0
    for _ in range(ROUNDS):
        times, command, answer, wrong = _framed(trips)
        framed.append(times)
        changed = max(changed, wrong)
        with trips.other_end(0, command, answer) as link:
            raw.append(_echoed(link, command, answer, trips.n)[trips.n // 10 :])
    ours, echo_us = (percentiles_us(np.concatenate(times)) for times in (framed, raw))
    row: Row = {"name": f"command to click block, decided and recorded, {trips.kind}, device in C", **ours}
    row |= {f"echo_{key}": value for key, value in echo_us.items() if key != "calls"}
    for key in ("p50", "p99"):
        both = ours[f"{key}_us"], echo_us[f"{key}_us"]
        row[f"{key}_of_echo"] = None if None in both else round(both[0] / both[1], 3)
    row |= {"samples": ours["calls"], "ratio_p50": row["p50_of_echo"]}
    return row | {"command_bytes": command, "answer_bytes": answer, "changed_percent": changed}


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


def _echoed(link: Link, command: int, answer: int, n: int) -> NDArray[np.int64]:
    """Times of `n` raw echoes; by the link's own calls where it has no descriptor."""
    times, fd = np.zeros(n, np.int64), descriptor_of(link)
    if fd is not None:
        if not echo(fd, np.ones(command, np.uint8), answer, times, np.zeros(4, np.int64)):
            raise LinkError(f"the echo over {link.name} ended early")
        return times
    for k in range(n):
        began, missing = link.now_ns(), answer
        link.write(bytes([1]) * command)
        while missing > 0:
            missing -= len(link.read(WAIT_NS / NS_PER_S))
        times[k] = link.now_ns() - began
    return times


def _framed(trips: Trips) -> tuple[NDArray[np.int64], int, int, float]:
    """Times of round trips, without the first tenth, the bytes of a command and of its answer, and percent of wrong decisions."""
    plan, decider = trips.plan, trips.decider
    core = Core(plan, decider, 1, 0)
    core.warm_up()
    core.begin(0, 0)
    steps = core.steps(streams.SESSION)
    assert plan.automaton is not None
    driver = HostDriver(core, WalkPlace(plan, plan.automaton))
    turn = Kernel(steps, FrameDecoder(), driver.arrays(streams.SESSION))
    turn.warm_up()
    control = turn.control
    first = encode_command(1, Opcode.SHOW, driver.body(0, 0), streams.SESSION)
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
    wrong = streams.percent_changed(rows, np.array(wanted, DECISION_DTYPE))
    all_times = np.concatenate(times)
    one = ClickBlock(1, 0, 100, 1, 100, 0, np.zeros(1, np.uint16), np.zeros(1, np.uint8))
    answer = len(encode_ack(Ack(1, 0, 0, ""), streams.SESSION)) + len(encode_clicks(one, streams.SESSION))
    return all_times[len(all_times) // 10 :], len(first), answer, wrong


def _called(turn: Kernel, link: Link, n: int) -> Iterator[NDArray[np.int64]]:
    """Call again and again what reads and writes the descriptor itself, for `n` round trips; yield the times of those of each call."""
    done, fd = 0, descriptor_of(link)
    assert fd is not None
    while done < n:
        ended = turn.run(fd, Limits(due_ns=int(now_ns(np.zeros(4, np.int64))) + WAIT_NS))
        if ended not in (ring.DUE, ring.FULL):
            raise LinkError(f"round trips over {link.name}: {ring.WHY[ended]} after {done}")
        left, blocks = turn.shows[:, ring.TIME], turn.blocks
        kept = blocks[1:, ring.RECORDED] - left[1 : len(blocks)]  # keeping a block, behind the command that answers it
        done += len(kept)
        yield np.diff(blocks[:, ring.DECIDED]) + kept


def _read_and_fed(turn: Kernel, link: Link, n: int) -> Iterator[NDArray[np.int64]]:
    """Read, decide and send what is decided, as a live run does where compiled code cannot read the link; `n` times.

    A time is from one decision to the next and to what is kept of it. The rest is settled while the answer is on its way.
    """
    decided_ns, done = 0, 0
    while done < n:
        data = link.read(WAIT_NS / NS_PER_S)
        ended = turn.feed([(link.now_ns(), data)])
        if ended == ring.BROKEN:
            link.write(turn.bytes_of(turn.shows[-1])[-turn.end.unsent :])
        elif ended != ring.ALL_TAKEN or not data:
            raise LinkError(f"round trips over {link.name}: {ring.WHY[ended]} after {done}")
        blocks = turn.blocks
        if len(blocks):
            kept_ns = int(blocks[-1, ring.RECORDED])
            yield np.array([kept_ns - decided_ns] if decided_ns else [], np.int64)
            decided_ns, done = int(blocks[-1, ring.DECIDED]), done + 1
