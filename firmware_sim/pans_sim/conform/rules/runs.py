"""Rules of sections 4 (states, lease) and 5 (the stream): whole runs, and what must agree in them."""

from __future__ import annotations

from typing import Any

from pans.protocol.wire import (
    HEADER,
    NO_OBJECT,
    ClickBlock,
    DeviceState,
    FrameBlock,
    Mark,
    MessageType,
    Opcode,
    StateReason,
    encode_hello,
)
from pans_sim.conform.bench import LEASE_MS, PATIENCE_S, STEP_S, Bench
from pans_sim.conform.plans import Layout
from pans_sim.conform.registry import NotTried, beyond_the_link, need, rule

CYCLES = 12
WIDTHS = 17, 33, 65  # channels whose word is of the next size
MESSAGES = 100  # cycles of three exposures: past the first byte of their numbers
OBJECTS = 300  # past the first byte of their numbers
LONG = 65_800  # exposures: past 16 bits of their numbers
LONG_RATE_HZ = 4000  # a host in Python takes so many blocks
LONG_S = 900.0  # that a check is willing to wait for so many
AHEAD = 4096  # messages that the window is ahead of the latest one, as a host grants them
HOUR_MS, ODD_LEASE_MS = 3_600_000, 70_789  # the longest lease; one of no whole seconds, beyond 32 bits of microseconds
LEASE_SLACK_S = 0.05  # of a device that looks at its lease between other things
HALF = 1 << 31
ASKED = 20  # STATUS
FIRST = 10  # messages that may leave before the window shuts
MOST_TO_FILL = 3000  # messages that a check is willing to wait for


def blocks_of(stream: list[Any]) -> list[Any]:
    """The blocks among the stream's messages."""
    return [one for one in stream if isinstance(one, (ClickBlock, FrameBlock))]


def exposures_of(block: Any) -> int:
    """How many exposures a block holds."""
    return len(block.words if isinstance(block, FrameBlock) else block.patterns)


def run_once(bench: Bench, **changes: Any) -> tuple[Layout, int, list[Any], Any]:
    """One short run: layout, start tick, stream messages, closing STATUS."""
    layout = bench.layout(**changes)
    start, stream, closing = bench.run(layout, CYCLES)
    need(bool(blocks_of(stream)), "a whole run brought no block")
    return layout, start, stream, closing


@rule(
    "4.14",
    "A run goes from ARMED to RUNNING at its start tick and to IDLE (completed) after its last cycle, each with a STATUS.",
)
def states(bench: Bench) -> None:
    layout = bench.layout()
    bench.upload(layout)
    bench.grant()
    bench.inbox.clear()
    start = bench.arm(CYCLES)
    bench.until_state(DeviceState.ARMED)
    running = bench.until_state(DeviceState.RUNNING)
    need(running.tick >= start, f"RUNNING at tick {running.tick}, the start tick is {start}")
    bench.grant(lease_ms=LEASE_MS)
    idle = bench.until_state(DeviceState.IDLE, layout.seconds(CYCLES) + PATIENCE_S)
    need(idle.reason == StateReason.COMPLETED, f"reason {idle.reason}, expected 1 (completed)")
    need(idle.tick >= start + CYCLES * layout.cycle_ticks, "IDLE before the last cycle was over")
    need(
        idle.next_exposure == CYCLES * layout.n_slots,
        f"next exposure {idle.next_exposure}, expected {CYCLES * layout.n_slots}",
    )
    need(idle.lease_left_ms == 0, f"{idle.lease_left_ms} ms of a lease left in IDLE")


@rule("4.15", "STOP and RESET end a run: IDLE with reason 2, from ARMED and from RUNNING.")
def stop(bench: Bench) -> None:
    bench.upload(bench.layout())
    for opcode in (Opcode.STOP, Opcode.RESET):
        for state in (DeviceState.ARMED, DeviceState.RUNNING):
            bench.arm(0)
            bench.until_state(state)
            bench.done(opcode)
            status = bench.until_state(DeviceState.IDLE)
            need(status.reason == StateReason.STOPPED, f"reason {status.reason} after {opcode.name}, expected 2")
            bench.inbox.clear()


@rule(
    "4.16",
    "A lease that nobody renews ends in SAFE (reason 3), from ARMED and from RUNNING, when it has run out and not before.",
)
def lease(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.grant()
    for ahead_s in (0.1, 20.0):
        runs_out(bench, ahead_s)
        bench.done(Opcode.RESET)


def runs_out(bench: Bench, ahead_s: float) -> None:
    """Arm for a start so far ahead, and let the lease run out."""
    lease_ms, hz = 400, bench.facts["tick_hz"]
    before = bench.ping().tx_tick
    bench.arm(0, lease_ms=lease_ms, ahead_s=ahead_s)
    after = bench.ping().rx_tick
    status = bench.until_state(DeviceState.SAFE)
    need(status.reason == StateReason.LEASE_EXPIRED, f"SAFE with reason {status.reason}, expected 3")
    lasted = lease_ms * hz / 1000
    need(
        status.tick >= before + lasted - 1,
        f"SAFE after {(status.tick - before) / hz * 1000:.0f} ms of a lease of {lease_ms}",
    )
    late = (status.tick - after - lasted) / hz
    need(late <= LEASE_SLACK_S, f"SAFE {late * 1000:.0f} ms after the lease of {lease_ms} ms had run out")


@rule("4.17", "GRANT with a lease renews it, GRANT with 0 leaves it as it is.")
def renewal(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.arm(0, lease_ms=500, ahead_s=0.1)
    for _ in range(4):
        bench.grant(lease_ms=500)
        bench.listen(0.25)
    need(
        all(getattr(one.message, "state", 0) != DeviceState.SAFE for one in bench.inbox),
        "SAFE although the lease was renewed",
    )
    bench.grant(lease_ms=300)
    after, hz = bench.ping().rx_tick, bench.facts["tick_hz"]
    bench.listen(0.15)
    bench.grant()
    late = (bench.until_state(DeviceState.SAFE).tick - after) / hz - 0.3
    need(late <= LEASE_SLACK_S, f"SAFE {late * 1000:.0f} ms after the lease, which a GRANT with 0 must not renew")


@rule(
    "4.18", "SAFE outlives the session and takes no ARM; STOP changes nothing, RESET leaves it, and uploads are kept."
)
def safe(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.arm(0, lease_ms=150, ahead_s=0.05)
    bench.until_state(DeviceState.SAFE)
    bench.done(Opcode.STOP)
    bench.arm_refused("ARM in SAFE, after STOP")
    bench.done(Opcode.RESET)
    bench.until_state(DeviceState.IDLE)
    bench.arm(0, lease_ms=150, ahead_s=0.05)
    bench.until_state(DeviceState.SAFE)
    bench.open(reset=False)
    bench.until_state(DeviceState.SAFE)
    bench.done(Opcode.RESET)
    bench.until_state(DeviceState.IDLE)


@rule("4.19", "A GRANT in IDLE starts no lease: STATUS says 0 ms.")
def grant_in_idle(bench: Bench) -> None:
    bench.grant(lease_ms=5000)
    bench.inbox.clear()
    status = bench.until_state(DeviceState.IDLE)
    need(status.lease_left_ms == 0, f"a GRANT in IDLE left a lease of {status.lease_left_ms} ms")


@rule("4.23", "STATUS says in ms what is left of the lease, and a GRANT of more than an hour is one of an hour.")
def lease_left(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.arm(
        1, lease_ms=ODD_LEASE_MS, ahead_s=20.0
    )  # a run that soon ends by itself, should this check not come to its end
    for asked, lease_ms in ((0, ODD_LEASE_MS), (0xFFFFFFFF, HOUR_MS), (ODD_LEASE_MS, ODD_LEASE_MS), (HOUR_MS, HOUR_MS)):
        before = bench.ping().rx_tick
        if asked:
            bench.grant(lease_ms=asked)
        bench.inbox.clear()
        bench.send(encode_hello(bench.session))  # a repetition, which STATUS follows
        status = bench.wait(MessageType.STATUS)
        gone_ms = (status.tick - before) * 1000 / bench.facts["tick_hz"] + (0 if asked else PATIENCE_S * 1000)
        need(
            lease_ms - gone_ms - 1 <= status.lease_left_ms <= lease_ms,
            f"{status.lease_left_ms} ms are left of a lease of {lease_ms}{f', asked for were {asked}' * (asked > HOUR_MS)}",
        )
    bench.done(Opcode.STOP)


beyond_the_link(
    "4.20",
    "In SAFE and IDLE the projector is dark and the gates are closed.",
    "light and gates need a detector and a scope",
)


@rule("5.1", "The stream's sequence starts at 0 with each ARM and counts up by 1.")
def sequence(bench: Bench) -> None:
    for cycles in (CYCLES, MESSAGES):
        layout = bench.layout(block_exposures=1)
        _, stream, _ = bench.run(layout, cycles)
        found = [one.seq for one in stream]
        need(len(found) >= cycles * layout.n_slots, f"{len(found)} messages of {cycles * layout.n_slots} exposures")
        wrong = next((k for k, seq in enumerate(found) if seq != k), None)
        need(wrong is None, f"sequence {found[wrong or 0]} in message {wrong}")


@rule(
    "5.2",
    "A block holds consecutive exposures of one cycle and one object, evenly spaced, and no more than the plan's blocks have.",
)
def block_rules(bench: Bench) -> None:
    spacing = bench.layout().period_ticks
    # As planned; with an uneven spacing within a cycle; and with cycles that follow each other evenly.
    for changes in ({}, {"block_exposures": 3, "pause_ticks": spacing // 2}, {"block_exposures": 4, "seamless": True}):
        layout, _, stream, _ = run_once(bench, **changes)
        following = 0
        for block in blocks_of(stream):
            count = exposures_of(block)
            need(
                block.exposure_index == following,
                f"a block begins with exposure {block.exposure_index}, expected {following}",
            )
            need(
                count <= layout.block_exposures,
                f"a block of {count} exposures, the plan's have {layout.block_exposures}",
            )
            cycles = {(following + k) // layout.n_slots for k in range(count)}
            need(len(cycles) == 1, f"a block with exposures of cycles {min(cycles)} and {max(cycles)}")
            gaps = {layout.begins(following + k + 1) - layout.begins(following + k) for k in range(count - 1)}
            need(gaps <= {layout.period_ticks}, f"a block with exposures {sorted(gaps)} ticks apart")
            need(
                block.period_ticks == layout.period_ticks,
                f"{block.period_ticks} ticks between exposures, the plan has {layout.period_ticks}",
            )
            following += count
        need(following == CYCLES * layout.n_slots, f"{following} exposures, the run has {CYCLES * layout.n_slots}")


@rule("5.3", "Blocks are CLICKS or FRAMES, as the mode says, and name the pattern that was shown.")
def shown(bench: Bench) -> None:
    bench_layout = bench.layout()
    most = bench.facts["channels"] if bench_layout.mode else bench_layout.n_patterns
    for n_patterns in sorted({min(most, n) for n in WIDTHS} | {bench_layout.n_patterns}):
        hold_stamps(bench, n_patterns)


def hold_stamps(bench: Bench, n_patterns: int) -> None:
    """Hold what blocks say was shown against a plan of so many patterns."""
    layout, _, stream, _ = run_once(bench, n_patterns=n_patterns)
    for block in blocks_of(stream):
        need(
            isinstance(block, FrameBlock) == bool(layout.mode),
            f"a {type(block).__name__} from a device in mode {layout.mode}",
        )
        if isinstance(block, ClickBlock):
            wanted = [layout.shown[(block.exposure_index + k) % layout.n_slots] for k in range(len(block.patterns))]
            need(block.patterns.tolist() == wanted, f"patterns {block.patterns.tolist()}, the plan shows {wanted}")
        else:
            words = block.words.shape[1]
            least, most = (word_bytes(channels) for channels in (n_patterns, bench.facts["channels"]))
            need(words in (1, 2, 4) or words % 8 == 0, f"words of {words} bytes")
            need(
                least <= words <= most, f"words of {words} bytes for {n_patterns} channels, expected {least} to {most}"
            )


def word_bytes(channels: int) -> int:
    """Bytes of a word of FRAMES: a bit for each channel, rounded up to 1, 2, 4 or a multiple of 8."""
    return next(size for size in (1, 2, 4, *range(8, 8200, 8)) if 8 * size >= channels)


@rule(
    "5.4",
    "An exposure begins at the start tick plus the plan's offset or later, by less than half the spacing and as much however long it is, "
    "and is no later than its STATUS.",
)
def timing(bench: Bench) -> None:
    least, ticks = [], []
    for longer in (0.0, 0.5):
        layout, start, stream, closing = run_once(bench, longer=longer)
        for block in blocks_of(stream):
            on_time(layout, start, block)
            need(
                block.tick <= closing.tick, f"a block of tick {block.tick}, and STATUS of tick {closing.tick} after it"
            )
        least.append(min(lateness(layout, start, block) for block in blocks_of(stream)))
        ticks.append(layout.exposure_ticks)
    # The least lateness of many exposures is free of jitter. A tick of the end or the middle moves with the length of the exposure.
    need(
        least[1] - least[0] <= max(2, (ticks[1] - ticks[0]) / 4),
        f"exposures of {ticks[0]} ticks are stamped {least[0]} ticks late, those of {ticks[1]} ticks {least[1]}: not at their begin",
    )


def lateness(layout: Layout, start: int, block: Any) -> int:
    """Ticks from when a block's first exposure is due to its stamp."""
    return int(block.tick) - start - layout.begins(block.exposure_index)


def on_time(layout: Layout, start: int, block: Any) -> None:
    """Hold a block's tick against the plan."""
    late = lateness(layout, start, block)
    need(late >= 0, f"exposure {block.exposure_index} began {-late} ticks before its time")
    need(
        late < layout.period_ticks / 2,
        f"exposure {block.exposure_index} began {late} ticks late, of a spacing of {layout.period_ticks}",
    )


@rule(
    "5.5",
    "The object of a block is the number of the visit since ARM, or unknown; a MARK is of an object that stands still, and stands at the "
    "tick of its first exposure.",
)
def objects(bench: Bench) -> None:
    lead = bench.layout().period_ticks // 4
    for changes, cycles in (({}, CYCLES), ({"lead_ticks": lead, "cycles_per_object": 1}, OBJECTS)):
        layout = bench.layout(**changes)
        start, stream, _ = bench.run(layout, cycles)
        need(bool(blocks_of(stream)), "a whole run brought no block")
        hold_objects(layout, start, stream)


def hold_objects(layout: Layout, start: int, stream: list[Any]) -> None:
    """Hold the objects of blocks and marks against the plan."""
    per_object = layout.n_slots * layout.cycles_per_object
    known = False
    for block in blocks_of(stream):
        wanted = block.exposure_index // per_object
        known = known or block.object_index != NO_OBJECT
        need(
            block.object_index in (wanted, NO_OBJECT),
            f"object {block.object_index} in exposure {block.exposure_index}, expected {wanted}",
        )
    for mark in (one for one in stream if isinstance(one, Mark)):
        need(
            mark.half_exposures == 0 or not known, f"MARK of a moving object {mark.object_index}, and objects in blocks"
        )
        if mark.half_exposures:
            continue
        need(
            mark.exposure_index == mark.object_index * per_object,
            f"MARK of object {mark.object_index} at exposure {mark.exposure_index}",
        )
        late = mark.tick - start - layout.begins(mark.exposure_index)
        need(
            0 <= late < layout.period_ticks / 2,
            f"MARK of object {mark.object_index} at a tick {late} after that of exposure {mark.exposure_index}",
        )


@rule(
    "5.6",
    "No stream message leaves before its sequence is below the limit of the latest GRANT; the limit is 0 in a new session.",
)
def window(bench: Bench) -> None:
    bench.grant()
    bench.open()
    layout = bench.layout(block_exposures=1)
    bench.upload(layout)
    bench.arm(CYCLES)
    bench.until_state(DeviceState.RUNNING)
    for limit in (0, 3, 7):
        if limit:
            bench.grant(limit)
        bench.listen(0.1 + 8 * layout.cycle_ticks / layout.tick_hz)
        seen = [one for one in bench.inbox if one.kind in (0x90, 0x91, 0x92)]
        need(len(seen) <= limit, f"{len(seen)} stream messages with a limit of {limit}")
    need(len(seen) == 7, f"{len(seen)} stream messages with a limit of 7 and more waiting")
    bench.stream()
    for limit, more in (
        (7 + HALF, False),
        (6, False),
        (6 + HALF, True),
    ):  # of 32 bits: what lies half of them ahead lies behind
        bench.grant(limit)
        bench.listen(0.1)
        found = len(bench.stream())
        need((found > 0) == more, f"{found} stream messages behind 7 with a limit of {limit}")
    bench.done(Opcode.STOP)


@rule(
    "5.7",
    "Exposures are in blocks or in drops: a block's first exposure = those before it + its drops, and STATUS agrees at the end; nothing "
    "is dropped before buffer_messages are held back.",
)
def books(bench: Bench) -> None:
    held = int(bench.facts.get("buffer_messages", 0))
    if not 0 < held <= MOST_TO_FILL:
        raise NotTried(f"a buffer of {held} messages: this check fills buffers of 1 to {MOST_TO_FILL}")
    layout = bench.layout(block_exposures=1)
    bench.upload(layout)
    bench.grant(limit=FIRST)
    bench.arm(0, lease_ms=60_000)
    full_s = layout.seconds(-(-(held + 40) // layout.n_slots))
    # Only when drops have begun does the window open: the blocks behind it must count them.
    bench.wait(
        MessageType.STATUS,
        lambda status: status.drops > 0,
        full_s + 3 * PATIENCE_S,
        "that counts drops of a full buffer",
    )
    bench.grant(limit=20)
    bench.listen(layout.seconds(CYCLES))
    bench.grant()
    bench.listen(0.3 + held * 1e-3)
    bench.done(Opcode.STOP)
    closing = bench.until_state(DeviceState.IDLE)
    bench.listen(0.3)
    stream = bench.stream()
    agree(stream, closing)
    first = next(block.seq for block in blocks_of(stream) if block.drops)
    need(
        first >= FIRST + held,
        f"the device dropped after {first - FIRST} messages that were held back, it announces {held}",
    )
    _, _, again = bench.run(layout, CYCLES)
    need(again.drops == 0, f"{again.drops} drops in a run without any: they are counted since ARM")


def agree(stream: list[Any], closing: Any) -> None:
    """Hold the drops of each block and of the last STATUS against the exposures' numbers."""
    blocks, before = blocks_of(stream), 0
    for block in blocks:
        need(
            block.exposure_index == before + block.drops,
            f"exposure {block.exposure_index} after {before} in blocks and {block.drops} drops",
        )
        before += exposures_of(block)
    need(bool(blocks) and blocks[-1].drops > 0, "no block came after the drops that STATUS counted")
    need(
        before + closing.drops == closing.next_exposure,
        f"{before} exposures in blocks, {closing.drops} drops, {closing.next_exposure} in STATUS",
    )


@rule("5.8", "STOP sends the exposures that have ended in a shorter block, and counts them.")
def broken_off(bench: Bench) -> None:
    layout = bench.layout(block_exposures=3, longer=4.0)  # an exposure is under way most of the time
    for stretch in (4.2, 4.3, 4.5, 4.7, 4.8):
        bench.start(layout)
        bench.listen(stretch * layout.cycle_ticks / layout.tick_hz)
        bench.done(Opcode.STOP)
        status = bench.until_state(DeviceState.IDLE)
        bench.listen(STEP_S)
        blocks = blocks_of(bench.stream())
        counted = sum(map(exposures_of, blocks))
        need(counted == status.next_exposure, f"{counted} exposures in blocks, next exposure {status.next_exposure}")
        for block in blocks:
            ends = block.tick + (exposures_of(block) - 1) * layout.period_ticks + layout.exposure_ticks
            need(
                ends <= status.tick, f"a block counts an exposure that ends at tick {ends}, after STOP at {status.tick}"
            )


@rule("5.9", "Bits beyond the last exposure or channel are 0.")
def spare_bits(bench: Bench) -> None:
    layout, _, stream, _ = run_once(bench)
    if not layout.mode:
        for body in (one for one in bench.bodies if one[0] == MessageType.CLICKS):
            piece = body[HEADER.size :]
            count = int.from_bytes(piece[28:30], "little")
            spare = piece[-1] >> (count % 8) if count % 8 else 0
            need(spare == 0, f"a block of {count} exposures with the last byte {piece[-1]:#04x}")
        return
    for block in blocks_of(stream):
        value = int.from_bytes(block.words[0].tobytes(), "little")
        need(value >> layout.n_patterns == 0, f"a word {value:#x} of {layout.n_patterns} channels")


@rule("5.10", "STATUS is repeated after the end of a run and says the same.")
def closing_repeated(bench: Bench) -> None:
    _, _, _, closing = run_once(bench)
    again = bench.until_state(DeviceState.IDLE)
    need(
        (again.next_exposure, again.drops) == (closing.next_exposure, closing.drops),
        "two STATUS after the end say different numbers",
    )


@rule("5.13", "In a run STATUS says how many exposures have begun.")
def begun(bench: Bench) -> None:
    layout = bench.layout(block_exposures=1, longer=4.0)  # an exposure is under way most of the time
    bench.start(layout)
    found = []
    for _ in range(ASKED):
        bench.listen(0.37 * layout.cycle_ticks / layout.tick_hz)
        bench.inbox = [one for one in bench.inbox if one.kind != MessageType.STATUS]
        bench.send(encode_hello(bench.session))  # a repetition, which STATUS follows
        found.append(bench.wait(MessageType.STATUS))
    bench.listen(layout.cycle_ticks / layout.tick_hz)
    bench.done(Opcode.STOP)
    bench.listen(STEP_S)
    ticks = [block.tick for block in blocks_of(bench.stream())]
    for status in found:
        least = sum(tick <= status.tick for tick in ticks)
        # One may begin between the tick that STATUS says and its sending.
        need(
            least <= status.next_exposure <= least + 1,
            f"STATUS of tick {status.tick} says next exposure {status.next_exposure}, {least} have begun",
        )


def long_run(bench: Bench) -> Layout:
    """Short cycles, fast: numbers of exposures, cycles, objects and messages grow alike. NotTried where that takes too long."""
    layout = bench.layout(rate_hz=LONG_RATE_HZ)
    if layout.seconds(LONG) > LONG_S:
        raise NotTried(f"{LONG} exposures take {layout.seconds(LONG):.0f} s")
    return layout


@rule(
    "5.11",
    "Past 65 536 exposures the numbers of messages, exposures and objects go on, and the ticks stay with the plan.",
    long=True,
)
def long_stream(bench: Bench) -> None:
    layout = long_run(bench)
    bench.upload(layout)
    bench.grant(AHEAD)
    start = bench.arm(0)
    seen, seq = 0, 0
    end_ns = bench.link.now_ns() + round((2 * layout.seconds(LONG) + PATIENCE_S) * 1e9)
    while seen < LONG:
        need(bench.link.now_ns() < end_ns, f"only {seen} of {LONG} exposures came in twice their time")
        bench.grant(seq + AHEAD, LEASE_MS)
        bench.listen(0.1)
        stream = bench.stream()
        bench.inbox.clear()
        for message in stream:
            need(message.seq == seq, f"sequence {message.seq} after {seq - 1}")
            seq += 1
        for block in blocks_of(stream):
            need(
                block.exposure_index == seen + block.drops,
                f"exposure {block.exposure_index} after {seen} in blocks and {block.drops} drops",
            )
            need(
                block.object_index in (block.exposure_index, NO_OBJECT),
                f"object {block.object_index} in exposure {block.exposure_index} of one cycle per object",
            )
            on_time(layout, start, block)
            seen += exposures_of(block)
    bench.done(Opcode.STOP)
    closing = bench.until_state(DeviceState.IDLE)
    bench.listen(0.3)
    seen += sum(map(exposures_of, blocks_of(bench.stream())))
    need(
        seen + closing.drops == closing.next_exposure,
        f"{seen} exposures in blocks, {closing.drops} drops, {closing.next_exposure} in STATUS",
    )


@rule("5.12", "More than 65 536 drops are counted, and the stream goes on behind them.", long=True)
def many_drops(bench: Bench) -> None:
    layout = long_run(bench)
    held = int(bench.facts.get("buffer_messages", 0))
    if not 0 < held <= MOST_TO_FILL:
        raise NotTried(f"a buffer of {held} messages: this check fills buffers of 1 to {MOST_TO_FILL}")
    bench.upload(layout)
    bench.arm(0)
    seconds = layout.seconds(LONG + held)
    end_ns = bench.link.now_ns() + round((seconds + 3 * PATIENCE_S) * 1e9)
    drops = 0
    while drops < LONG and bench.link.now_ns() < end_ns:
        bench.grant(0, LEASE_MS)
        status = bench.wait(MessageType.STATUS)
        need(status.drops >= drops, f"{status.drops} drops in STATUS after {drops}")
        drops = status.drops
    need(drops >= LONG, f"{drops} drops in STATUS after {seconds:.0f} s with a shut window")
    bench.grant(lease_ms=LEASE_MS)
    bench.listen(0.3 + held * 1e-3)
    bench.done(Opcode.STOP)
    closing = bench.until_state(DeviceState.IDLE)
    bench.listen(0.3)
    agree(bench.stream(), closing)
