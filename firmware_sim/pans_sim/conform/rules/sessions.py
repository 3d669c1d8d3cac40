"""Rules of sections 2 and 3 (sessions, WELCOME) and 6 (probes, the clock)."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from pans.protocol.wire import (
    AUTOMATON_SCHEMA,
    DARK_PATTERN,
    MAX_SLOTS_PER_CHUNK,
    DeviceState,
    MessageType,
    Opcode,
    PatternChunk,
    encode_frame,
    pack_command,
    wrong_facts,
)
from pans.protocol.wire import messages as wire
from pans_sim.conform.bench import LEASE_MS, PATIENCE_S, QUIET_S, Bench
from pans_sim.conform.registry import NotTried, Silent, beyond_the_link, need, rule

CLOCK_PPM = 1000.0  # section 9
CLOCK_S = 2.0
FLOOD = 300
FAST_HZ = 10_000  # blocks of one exposure: 570 kB/s
STATUS_EVERY_S = 1.3  # once a second, and a little for the way
AT_ONCE_S = 0.3  # of what follows at once: less than a second, in which STATUS comes by itself
PROBES_AT_ONCE = 4
PAUSE_S = 0.05  # between sessions, in which ticks pass


@rule("2.1", "HELLO is answered with WELCOME in the new session, and STATUS follows at once.")
def welcome(bench: Bench) -> None:
    bench.open(reset=False)
    bench.wait(MessageType.STATUS, within_s=0.5, what="after WELCOME")


@rule(
    "2.2",
    "HELLO with the nonce of the present session is answered again, with WELCOME and STATUS, and changes nothing.",
)
def repeated_hello(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.arm(0, ahead_s=20.0, lease_ms=20_000)
    bench.listen(AT_ONCE_S)
    for _ in range(3):  # one STATUS a second comes by itself
        bench.inbox.clear()
        bench.send(wire.encode_hello(bench.session))
        bench.wait(MessageType.WELCOME, what="to a repeated HELLO")
        status = bench.wait(MessageType.STATUS, within_s=AT_ONCE_S, what="after WELCOME to a repeated HELLO")
        need(status.state == DeviceState.ARMED, f"a repeated HELLO left ARMED for {DeviceState(status.state).name}")
    ack = bench.command(Opcode.STOP, number=bench.last_id)
    need(ack.last_id == bench.last_id, f"a repeated HELLO forgot the command ids: last id {ack.last_id}")
    bench.done(Opcode.STOP)


@rule("2.3", "A new session forgets uploads, command ids and the run: the device is IDLE.")
def new_session(bench: Bench) -> None:
    bench.upload(bench.layout())
    bench.arm(0, ahead_s=0.5)
    bench.open()
    ack = bench.command(Opcode.STOP)
    need(ack.last_id == bench.last_id, f"the command ids did not start over: last id {ack.last_id}")
    bench.arm_refused("ARM after a new session")
    for left_out, what in ((Opcode.LOAD_PLAN, "plan"), (Opcode.LOAD_PATTERN, "patterns")):
        bench.upload(bench.layout())
        bench.open()
        for opcode, body in bench.layout().commands():
            if opcode != left_out:
                bench.done(opcode, body)
        bench.arm_refused(f"ARM with the {what} of the session before")
    layout = bench.layout()
    longer = PatternChunk(0, 0, layout.pixels + 1, np.zeros(1, np.uint16))
    if longer.n_pixels <= bench.facts["pattern_pixels"]:
        bench.command(Opcode.LOAD_PATTERN, pack_command(longer))  # refused where patterns have one size
        bench.open()
    bench.upload(layout)


@rule("2.4", "Frames of another session are dropped, and a new one brings no answer to what an earlier one asked.")
def foreign(bench: Bench) -> None:
    bench.send(
        wire.encode_ping(1, 1, bench.session ^ 2)
        + wire.encode_command(bench.last_id + 1, Opcode.STOP, b"", bench.session ^ 2)
    )
    bench.listen(0.2)
    need(not any(one.kind in (MessageType.PONG, MessageType.ACK) for one in bench.inbox), "one of them was answered")
    bench.done(Opcode.STOP)
    asked = wire.encode_ping(1, 1, bench.session) + wire.encode_command(
        bench.last_id + 1, Opcode.STOP, b"", bench.session
    )
    bench.session, bench.last_id = bench.session ^ 2, 0
    bench.inbox.clear()
    bench.send(asked + wire.encode_hello(bench.session))
    bench.wait(MessageType.WELCOME)
    bench.silent(MessageType.PONG, "in a new session, to a PING of the one before")
    need(not any(one.kind == MessageType.ACK for one in bench.inbox), "ACK came of a command of the session before")


@rule(
    "2.5",
    "HELLO of another schema or protocol version is answered with the device's own WELCOME, and there is no session then.",
)
def other_schema(bench: Bench) -> None:
    for schema, protocol in ((wire.SCHEMA ^ 1, wire.PROTOCOL_VERSION), (wire.SCHEMA, wire.PROTOCOL_VERSION + 1)):
        what = f"HELLO of schema {schema:#010x}, version {protocol}"
        bench.session ^= 4 * protocol
        bench.inbox.clear()
        bench.send(encode_frame(MessageType.HELLO, wire.STRUCTS["HELLO"].pack(schema, protocol), bench.session))
        found = bench.wait(MessageType.WELCOME, what=f"to a {what}")
        need(found.schema == wire.SCHEMA, f"WELCOME says schema {found.schema:#010x}")
        need(found.protocol == wire.PROTOCOL_VERSION, f"WELCOME says version {found.protocol}")
        bench.send(wire.encode_ping(1, 1, bench.session))
        bench.silent(MessageType.PONG, f"in a session that must not be, after a {what}")


@rule("2.6", "The tick counter does not restart with a session, and the epoch stays the same.")
def ticks_go_on(bench: Bench) -> None:
    before, epoch = bench.ping().tx_tick, bench.facts.get("epoch")
    bench.listen(PAUSE_S)
    bench.open()
    after = bench.ping().rx_tick
    need(after >= before, f"tick {before} in one session, {after} in the next")
    need(bench.facts.get("epoch") == epoch, f"epoch {epoch} in one session, {bench.facts.get('epoch')} in the next")


@rule("2.7", "STATUS comes once per second, with the present tick.")
def status_every_second(bench: Bench) -> None:
    bench.listen(0.05)
    bench.inbox.clear()
    for _ in range(2):
        before = bench.ping().rx_tick
        status = bench.wait(MessageType.STATUS, within_s=STATUS_EVERY_S)
        after = bench.ping().rx_tick
        need(
            before <= status.tick <= after,
            f"STATUS of tick {status.tick}, PONGs of {before} before and {after} after it",
        )


beyond_the_link(
    "2.8", "Another epoch says that the tick counter has restarted.", "the device would have to be switched off"
)


@rule("2.9", "HELLO of session 0 is dropped.")
def no_nonce(bench: Bench) -> None:
    session, bench.session = bench.session, 0
    bench.send(wire.encode_hello(0))
    bench.silent(MessageType.WELCOME, "to a HELLO of session 0")
    bench.session = session
    bench.ping()


@rule("3.1", "WELCOME's map holds what it must, in its ranges, and no key twice.")
def facts(bench: Bench) -> None:
    wrong = wrong_facts(bench.facts)
    need(not wrong, "; ".join(wrong))


@rule("3.2", "tick_hz and mode are those of the profile.")
def facts_of_profile(bench: Bench) -> None:
    for key, expected in (("tick_hz", bench.profile.clock.tick_hz), ("mode", bench.profile.mode)):
        need(
            bench.facts[key] == expected,
            f"{key} is {bench.facts[key]}, the profile {bench.profile.name} says {expected}",
        )


@rule("3.3", "A device that announces automata does so with the number of the extension.")
def announced(bench: Bench) -> None:
    found = bench.facts.get("automaton_schema", AUTOMATON_SCHEMA)
    need(found == AUTOMATON_SCHEMA, f"automaton_schema is {found:#010x}, expected {AUTOMATON_SCHEMA:#010x}")


@rule("3.4", "WELCOME's tick is the present one.")
def present_tick(bench: Bench) -> None:
    bench.listen(PAUSE_S)
    before = bench.ping().tx_tick
    bench.open()
    after, tick = bench.ping().rx_tick, bench.facts.get("tick")
    if tick is None:
        raise NotTried("WELCOME says no tick")
    need(before <= tick <= after, f"WELCOME says tick {tick}, PONGs {before} before and {after} after it")


@rule("3.5", "As many patterns and slots as WELCOME announces are taken.")
def announced_memory(bench: Bench) -> None:
    layout, facts = bench.layout(), bench.facts
    if facts["pattern_memory"] > 0:
        last = next(layout.patterns())._replace(pattern=facts["pattern_memory"] - 1)
        bench.done(Opcode.LOAD_PATTERN, pack_command(last))
    plan = layout.chunk()
    most = facts["slot_memory"]
    full = bench.layout(shown=(DARK_PATTERN,) * min(most, MAX_SLOTS_PER_CHUNK))  # as many as one piece holds
    bench.done(Opcode.LOAD_PLAN, pack_command(full.chunk()))
    whole = plan._replace(
        n_slots=most, cycle_ticks=min(1 << 48, (most + 1) * layout.period_ticks), slots=plan.slots[:1]
    )
    bench.done(Opcode.LOAD_PLAN, pack_command(whole))


@rule("6.1", "PONG echoes probe id and host nanoseconds.")
def echo(bench: Bench) -> None:
    for number, ns in ((0, 0), (0xFFFFFFFF, (1 << 64) - 1), (0x01020304, 0x0102030405060708)):
        bench.send(wire.encode_ping(number, ns, bench.session))
        pong = bench.wait(MessageType.PONG)
        need(
            (pong.probe_id, pong.host_ns) == (number, ns),
            f"PING {number:#x}, {ns:#x} came back as {pong.probe_id:#x}, {pong.host_ns:#x}",
        )


@rule("6.2", "A PING is answered once.")
def answered_once(bench: Bench) -> None:
    bench.ping()
    bench.silent(MessageType.PONG, "a second time")


@rule("6.3", "The ticks of arrival and departure lie within the time that the probe was away, and never go back.")
def clock_honesty(bench: Bench) -> None:
    hz, last = bench.facts["tick_hz"], 0
    for _ in range(20):
        sent_ns = bench.link.now_ns()
        pong = bench.ping()
        away = (bench.link.now_ns() - sent_ns) * 1e-9 * hz * (1 + CLOCK_PPM * 1e-6) + 1 + 20e-6 * hz
        need(pong.rx_tick >= last, f"tick {pong.rx_tick} after {last}")
        need(pong.rx_tick <= pong.tx_tick, f"departure {pong.tx_tick} before arrival {pong.rx_tick}")
        need(pong.tx_tick - pong.rx_tick <= away, f"held for {pong.tx_tick - pong.rx_tick} ticks, away for {away:.0f}")
        last = pong.tx_tick


@rule("6.4", "The tick counter runs at tick_hz, within 1000 ppm.")
def clock_rate(bench: Bench) -> None:
    def probe() -> tuple[int, float, float]:
        best = None
        for _ in range(16):
            sent_ns = bench.link.now_ns()
            pong = bench.ping()
            trip_ns = bench.link.now_ns() - sent_ns
            if best is None or trip_ns < best[2]:
                best = (pong.rx_tick, sent_ns + trip_ns / 2, trip_ns)
        assert best is not None
        return best

    tick, at_ns, trip_ns = probe()
    bench.listen(CLOCK_S)
    later_tick, later_ns, later_trip_ns = probe()
    wanted = (later_ns - at_ns) * 1e-9 * bench.facts["tick_hz"]
    ppm = ((later_tick - tick) / wanted - 1) * 1e6
    allowed = CLOCK_PPM + (trip_ns + later_trip_ns) / 2 / (later_ns - at_ns) * 1e6
    need(abs(ppm) <= allowed, f"the counter runs {ppm:+.0f} ppm off, allowed {allowed:.0f}")


@rule("6.5", "A flood of probes and repetitions does no harm: the device answers when it is over, and no probe twice.")
def flood(bench: Bench) -> None:
    bench.done(Opcode.STOP)
    repeated = wire.encode_command(bench.last_id, Opcode.STOP, b"", bench.session)
    for first in range(1000, 1000 + FLOOD, 30):
        bench.send(b"".join(wire.encode_ping(n, 1, bench.session) for n in range(first, first + 30)) + repeated * 10)
    bench.listen(0.5)
    seen = [one.message.probe_id for one in bench.inbox if one.kind == MessageType.PONG]
    need(len(seen) == len(set(seen)), "a probe was answered twice")
    need(set(seen) <= set(range(1000, 1000 + FLOOD)), "a probe was answered that was never sent")
    bench.ping()
    status = bench.wait(MessageType.STATUS, within_s=PATIENCE_S)
    need(status.state == DeviceState.IDLE, f"the flood left the device {DeviceState(status.state).name}")


@rule(
    "6.6",
    "Answers are in time while the stream runs, also one that fills the line: a PING within 250 ms, a command within 2 s, STATUS every "
    "second.",
)
def answers_in_a_run(bench: Bench) -> None:
    for layout in (bench.layout(block_exposures=1), bench.layout(rate_hz=FAST_HZ)):
        bench.start(layout)
        bench.grant(lease_ms=LEASE_MS)
        answered = 0
        for _ in range(16):
            with suppress(Silent):
                bench.ping(within_s=0.25)
                answered += 1
        need(answered > 0, "none of sixteen probes was answered within 250 ms")
        for _ in range(8):
            bench.grant(lease_ms=LEASE_MS)
            bench.command(Opcode.LOAD_PLAN)  # refused outside IDLE, but acknowledged
            bench.listen(0.2)
        bench.wait(MessageType.STATUS, within_s=STATUS_EVERY_S, what="while the stream runs")
        bench.done(Opcode.STOP)
        bench.until_state(DeviceState.IDLE)
        bench.stream()


@rule("6.7", "Four PINGs that come at once are answered, in the order in which they came.")
def probes_at_once(bench: Bench) -> None:
    numbers = list(range(7001, 7001 + PROBES_AT_ONCE))
    bench.send(b"".join(wire.encode_ping(number, 1, bench.session) for number in numbers))
    bench.listen(QUIET_S)
    found = [one.message.probe_id for one in bench.inbox if one.kind == MessageType.PONG]
    need(found == numbers, f"PINGs {numbers} at once were answered as {found}")
