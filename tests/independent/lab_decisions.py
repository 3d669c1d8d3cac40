"""From recorded messages to decisions, as a lab would write it from docs/reference/formats.md, "From exposures to decisions".

The back ends that any reader can recompute bit for bit, and the rules of still runs, in plain loops.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from lab_bundle import Bundle, demand
from lab_frames import CLICKS, COMMAND, COUNTS, FRAMES, MARK, STATUS, FrameCutter, open_body
from lab_recording import ROW, Recording
from numpy.typing import NDArray

DARK, NO_OBJECT = 0xFFFF, 0xFFFFFFFF
GAP, WRONG, INCOMPLETE = 1, 2, 4
IDLE, SAFE, COMPLETED = 0, 3, 1
NO_LABEL = 0xFFFF
ABSTAINED, NOT_FINITE = 8, 64

Counts = NDArray[np.int64]
Scores = Callable[[Counts, int], NDArray[Any]]


def table_scores(bundle: Bundle) -> Scores:
    """Return the back end `table`."""
    table, base = bundle.parts["table"], bundle.largest + 1
    return lambda counts, shots: table[sum(int(count) * base**i for i, count in enumerate(counts))]


def float64_scores(bundle: Bundle) -> Scores:
    """Return the back end `float64`."""
    layers = bundle.layers()

    def scores(counts: Counts, shots: int) -> NDArray[Any]:
        x = counts / np.float64(shots * bundle.largest)
        for weights, bias, relu in layers:
            x = x @ weights.astype(np.float64) + bias.astype(np.float64)
            x = np.maximum(x, 0.0) if relu else x
        return x

    return scores


def int8_scores(bundle: Bundle) -> Scores:
    """Return the back end `int8`."""
    sizes = bundle.parts["int8_sizes"].tolist()
    scale, bias = bundle.parts["int8_affine"]

    def scores(counts: Counts, shots: int) -> NDArray[Any]:
        x, unit, weight_at, at = counts, np.float32(1) / np.float32(shots * bundle.largest), 0, 0
        for n_in, n_out in pairwise(sizes):
            flat = bundle.parts["int8_weights"][weight_at : weight_at + n_in * n_out]
            sums = (x @ flat.reshape(n_in, n_out).astype(np.int64)).astype(np.float32)
            y = sums * (scale[at : at + n_out] * unit) + bias[at : at + n_out]
            x = (np.clip(y, np.float32(0), np.float32(255)) + np.float32(0.5)).astype(np.int64)
            weight_at, at, unit = weight_at + n_in * n_out, at + n_out, np.float32(1)
        return y

    return scores


BACKENDS = {"table": table_scores, "float64": float64_scores, "int8": int8_scores}


def verdict(scores: NDArray[Any]) -> tuple[int, np.float32, int]:
    """Return label, probability and flags of one row of scores."""
    wide = scores.astype(np.float64)
    if np.isnan(wide).any() or np.isinf(wide.max()):
        return NO_LABEL, np.float32(0), NOT_FINITE | ABSTAINED
    label = int(wide.argmax())
    return label, np.float32(1 / np.exp(wide - wide[label]).sum()), 0


@dataclass
class Plan:
    """What LOAD_PLAN said."""

    parallel: bool
    patterns: int
    exposure_ticks: int
    cycles_per_object: int
    slots: list[tuple[int, int, int]]  # start, pattern, shot
    largest: int = 1  # the largest number that READ_COUNTS asked for; 1: clicks
    channels: int = 0  # detectors of whose clicks the number is made; 0: a photon number

    @property
    def visit(self) -> int:
        """Exposures of one object, V."""
        return len(self.slots) * self.cycles_per_object


@dataclass
class Arm:
    """One ARM command and the session that it was sent in."""

    session: int
    start_tick: int
    cycles: int


def sent_plan(recording: Recording) -> tuple[Plan, list[Arm]]:
    """Return the plan and the ARMs that were sent, repetitions left out."""
    pieces: dict[int, bytes] = {}
    arms: dict[int, Arm] = {}
    head: tuple[int, ...] = ()
    largest, channels = 1, 0
    for _, data in recording.commands:
        cutter = FrameCutter()
        for kind, session, payload in cutter.feed(data):
            if kind != COMMAND:
                continue
            _, opcode, _, _ = struct.unpack_from("<IBBH", payload)
            body = payload[8:]
            if opcode == 0x02:
                head = struct.unpack_from("<BBHIIIIQHHI", body)
                pieces[head[4]] = body[36:]
            elif opcode == 0x0A:
                largest, channels = struct.unpack("<HH", body)
            elif opcode == 0x03:
                start, cycles, _, _ = struct.unpack("<QQII", body)
                arms[session] = Arm(session, start, cycles)
        demand(cutter.damaged == 0, "a damaged frame among the commands")
    mode, _, patterns, n_slots, _, exposure_ticks, _, _, _, _, cycles_per_object = head
    slots = list(struct.iter_unpack("<QHH", b"".join(pieces[first] for first in sorted(pieces))))
    demand(len(slots) == n_slots, "slots of the plan are missing")
    return Plan(bool(mode), patterns, exposure_ticks, cycles_per_object, slots, largest, channels), list(arms.values())


# ---- the rules ----


@dataclass
class Window:
    """One window of a visit: which exposures of the visit belong to it, and what they gave."""

    members: list[int]
    counts: Counts
    right: int = 0
    wrong: int = 0


@dataclass
class Decisions:
    """Follows the streams of one still run."""

    plan: Plan
    scores: Scores
    shots: int
    rows: list[tuple[Any, ...]] = field(default_factory=list)
    last_end: int = 0

    def begin(self, arm: Arm) -> None:
        """Follow the stream of `arm`."""
        self.arm = arm
        self.sequence = self.exposure = self.visit = 0
        self.marks: dict[int, int] = {}
        self.settled = False
        self.status: tuple[int, ...] | None = None
        self.told_end: int | None = None
        self._open_visit()

    @property
    def end(self) -> float:
        """Exposures of the whole stream."""
        return self.arm.cycles * len(self.plan.slots) or float("inf")

    def _open_visit(self) -> None:
        plan = self.plan
        per_cycle = 1 + max(shot for _, pattern, shot in plan.slots if pattern != DARK)
        total = per_cycle * plan.cycles_per_object
        demand(total % self.shots == 0, "shots do not make whole windows")
        self.windows = [Window([], np.zeros(plan.patterns, np.int64)) for _ in range(total // self.shots)]
        self.window_of: dict[int, Window] = {}
        for cycle in range(plan.cycles_per_object):
            for slot, (_, pattern, shot) in enumerate(plan.slots):
                if pattern != DARK:
                    window = self.windows[(cycle * per_cycle + shot) // self.shots]
                    window.members.append(cycle * len(plan.slots) + slot)
                    self.window_of[window.members[-1]] = window
        self.next_window, self.object = 0, NO_OBJECT

    # -- messages ------------------------------------------------------------------------------------------------------

    def take(self, kind: int, payload: bytes) -> None:
        """Take one message of this stream."""
        if kind == STATUS:
            self._on_status(payload)
        elif kind == MARK and len(payload) == 32:
            sequence, number, truth = struct.unpack_from("<IIh", payload)
            if self._is_next(sequence):
                self.marks.pop(number, None)
                self.marks[number] = truth
                if len(self.marks) > 4096:
                    del self.marks[next(iter(self.marks))]
        elif kind in (CLICKS, FRAMES, COUNTS) and len(payload) >= 36:
            self._on_block(kind, payload)

    def _is_next(self, sequence: int, first: int = 0) -> bool:
        ahead = (sequence - self.sequence) % (1 << 32)
        if ahead >= 1 << 31 or self.settled or first - self.exposure > 1 << 18:
            return False
        self.sequence = (sequence + 1) % (1 << 32)
        return True

    def _on_block(self, kind: int, payload: bytes) -> None:
        sequence, _, tick, first, spacing, n, width, number = struct.unpack_from("<IIQQIHHI", payload)
        rest = payload[36:]
        size = {CLICKS: 2 * n + (n + 7) // 8, COUNTS: 3 * n, FRAMES: n * width}[kind]
        if n == 0 or size == 0 or len(rest) != size or (kind == COUNTS and max(rest[2 * n :]) > width):
            return
        if not self._is_next(sequence, first) or first < self.exposure:
            return
        self.exposure = first + n
        plan, shown = self.plan, () if kind == FRAMES else struct.unpack_from(f"<{n}H", rest)
        fits = first % plan.visit + n <= plan.visit and first + n <= self.end and self._stamps_fit(shown)
        largest = width if kind == COUNTS else 1
        if (kind == FRAMES) != plan.parallel or not fits or (kind == FRAMES and 8 * width < plan.patterns):
            return
        if largest != plan.largest:
            return
        end = tick + (n - 1) * spacing + plan.exposure_ticks
        self.last_end = end
        self._settle(first, lambda exposure: tick)
        while self.visit < first // plan.visit:
            self._next_visit()
        self.object = number
        if kind != FRAMES:
            numbers = _bits(rest[2 * n :]) if kind == CLICKS else np.frombuffer(rest[2 * n :], np.uint8)
            for i, one in enumerate(shown):
                self._count_one(first + i, one, int(numbers[i]))
        else:
            for i, word in enumerate(_bits(rest).reshape(n, 8 * width)):
                window = self.window_of.get((first + i) % plan.visit)
                if window is not None:
                    window.counts += word[: plan.patterns]
                    window.right += plan.patterns
        self._settle(first + n, lambda exposure: tick + (exposure - first) * spacing + plan.exposure_ticks)

    def _stamps_fit(self, _stamps: Sequence[int]) -> bool:
        return True  # of fixed patterns any stamp is counted, right or wrong

    def _count_one(self, exposure: int, shown: int, bit: int) -> None:
        within = exposure % self.plan.visit
        window = self.window_of.get(within)
        if window is None:
            return
        if shown == self.plan.slots[within % len(self.plan.slots)][1]:
            window.counts[shown] += bit
            window.right += 1
        else:
            window.wrong += 1

    # -- windows -------------------------------------------------------------------------------------------------------

    def _settle(self, up_to: float, tick_of: Callable[[int], int]) -> None:
        """Settle the windows that are complete or whose last exposure lies before exposure `up_to`."""
        while True:
            if self.next_window == len(self.windows):
                if (self.visit + 1) * self.plan.visit >= up_to:
                    return
                self._next_visit()
            window = self.windows[self.next_window]
            last = self.visit * self.plan.visit + self._last(window)
            if window.right < self._needed(window) and last >= up_to:
                return
            self._decide(window, tick_of(last), 0)

    def _last(self, window: Window) -> int:
        """Its last exposure in the visit."""
        return window.members[-1]

    def _needed(self, _window: Window) -> int:
        return self.shots * self.plan.patterns

    def _verdict(self, window: Window) -> tuple[int, np.float32, int]:
        return verdict(self.scores(window.counts, self.shots))

    def _next_visit(self) -> None:
        self.visit += 1
        self._open_visit()

    def _decide(self, window: Window, tick: int, flags: int) -> None:
        missing = self._needed(window) - window.right - window.wrong
        flags |= (GAP if missing else 0) | (WRONG if window.wrong else 0)
        label, probability = NO_LABEL, np.float32(0)
        if flags:
            flags |= ABSTAINED
        else:
            label, probability, flags = self._verdict(window)
        last = self.visit * self.plan.visit + self._last(window)
        shot = self.next_window * self.shots
        truth = -1 if self.object == NO_OBJECT else self.marks.get(self.object, -1)
        clicks, crc = int(window.counts.sum()), zlib.crc32(window.counts.astype("<i8").tobytes())
        place = (len(self.rows), tick, last, self.object, shot)
        self.rows.append((*place, clicks, label, truth, flags, probability, crc, self._exposures(window)))
        self.next_window += 1

    def _exposures(self, _window: Window) -> int:
        return 0  # of fixed patterns

    # -- the end -------------------------------------------------------------------------------------------------------

    def _on_status(self, payload: bytes) -> None:
        if len(payload) != 28:
            return
        status = struct.unpack("<BBHIIQQ", payload)
        state, reason, _, _, _, tick, following = status
        if self.settled or tick < self.arm.start_tick:
            return
        self.status = status
        if (state, reason) != (IDLE, COMPLETED):
            return
        if min(following, self.end) > self.exposure and (self.told_end is None or tick <= self.told_end):
            self.told_end = tick
            return
        self._finish(status)

    def _finish(self, status: tuple[int, ...]) -> None:
        self.settled = True
        self._settle(min(status[6], self.end), lambda exposure: status[5])

    def _touched(self) -> bool:
        return self.next_window > 0 or any(window.right or window.wrong for window in self.windows)

    def close(self, another: bool) -> None:
        """The stream's messages are over; `another` stream follows."""
        if not self.settled and self.status is not None and self.status[0] in (IDLE, SAFE):
            self._finish(self.status)
        was_last = (self.visit + self._touched()) * self.plan.visit >= self.end
        if (another or (was_last and not self.settled)) and self._touched():
            for window in self.windows[self.next_window :]:
                self._decide(window, self.last_end, INCOMPLETE)


def _bits(data: bytes) -> NDArray[np.uint8]:
    return np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")


def decide_again(recording: Recording, bundle: Bundle, backend: str = "") -> NDArray[np.void]:
    """Return the rows that the messages of `recording` give, ROW (n,); the patterns are fixed."""
    config = recording.header["config"]
    demand("drive" not in config, "patterns follow from the clicks: lab_automaton.py")
    scores = BACKENDS[backend or config["backend"]](bundle)
    return run_again(recording, lambda plan: Decisions(plan, scores, config["shots"]))


def run_again(recording: Recording, make: Callable[[Plan], Decisions]) -> NDArray[np.void]:
    """Give the messages of `recording` to what `make` returns for its plan; return the rows."""
    config = recording.header["config"]
    demand("flow" not in config, "objects flow past")
    demand(config["dark"].get("guard", {}).get("policy", "warn") == "warn", "the dark counts decide too")
    plan, arms = sent_plan(recording)
    channels = config.get("channels_at_once", 0)
    largest = 2**channels - 1 if channels else config.get("photon_number_max", 1)
    demand((plan.largest, plan.channels) == (largest, channels), "the numbers that were asked for")
    run = make(plan)
    run.begin(arms.pop(0))
    for _, body in recording.messages:
        kind, session, payload = open_body(body)
        while session != run.arm.session:
            run.close(another=True)
            run.begin(arms.pop(0))
        run.take(kind, payload)
    while arms:
        run.close(another=True)
        run.begin(arms.pop(0))
    run.close(another=False)
    return np.array(run.rows, ROW)
