"""The kernel by itself: how a call ends, and what it leaves to Python.

Streams with faults go through it in tests/runtime/decide (tests/oracles/streams.py), whole runs with faults in the fault grid.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import numpy as np
from heads import head_bundle, random_layers
from inner_kernels import called
from plans import shot_major
from streams import SESSION, click_frames

from pans.bundle.backends.choose import make_decider
from pans.decide.kernel import arrays as ring
from pans.decide.kernel import show as answer
from pans.decide.kernel.calls import Kernel, Limits
from pans.decide.kernel.stream_core import StreamCore
from pans.decide.still.core import Core
from pans.live.drive import HostDriver, WalkPlace
from pans.protocol.wire import DARK_PATTERN, Opcode, pack_body
from pans.protocol.wire.commands import Show, unpack_command
from pans.protocol.wire.framing import FrameDecoder
from pans.protocol.wire.kernels import HELD
from pans.protocol.wire.messages import Ack, decode_command, encode_ack
from pans_sim.testing import small_setup

LONG_NS = 10_000_000_000


def streaming() -> tuple[StreamCore, list[bytes]]:
    plan, decider = shot_major(3, 2), make_decider(head_bundle(random_layers([3, 12, 3], seed=3)), backend="table")
    sent = [(int(slot), 1) for _ in range(4) for slot in plan.slot_pattern]
    return StreamCore(plan, decider, 1, 0, SESSION), click_frames(plan, sent, np.random.default_rng(1), 4)


def test_the_refusal_of_a_name_is_taken_in_the_call_that_sent_it() -> None:
    """One late name must not make the next one late; any other refusal is Python's."""
    taken = called(answer.take_ack)
    control = np.zeros(ring.N_CONTROL, np.int64)
    control[[ring.NEXT_ID, ring.OLDEST_ID, ring.FIRST_ID, ring.ARRIVAL_NS]] = 12, 9, 9, 55

    def told(last: int, refused: int, status: int, mask: int) -> int:
        frame = FrameDecoder().feed(encode_ack(Ack(last, refused, status, "late", mask), SESSION))[0]
        body = np.frombuffer(pack_body(frame), np.uint8).copy()
        return int(taken(body, np.uint64(0), np.uint64(len(body)), control))

    assert told(11, 11, 5, 1) == answer.IS_ODD  # three at once
    assert told(9, 9, 0, 1) == answer.IS_ODD  # without a reason
    assert told(9, 9, 5, 3) == answer.IS_REFUSED
    assert control[[ring.OLDEST_ID, ring.OLDEST_NS]].tolist() == [10, 55]
    assert told(10, 9, 5, 2) == answer.IS_DONE  # the refusal before it stays named
    control[ring.FIRST_ID] = 12
    assert told(11, 11, 5, 1) == answer.IS_ODD  # sent by another call, or by Python
    assert control[ring.OLDEST_ID] == 11


def test_a_signal_ends_a_call_that_waits() -> None:
    streamed, _ = streaming()
    streamed.warm_up()  # else the signal may come while the kernel is compiled
    ours, theirs = socket.socketpair()
    came: list[int] = []
    before = signal.signal(signal.SIGUSR1, lambda number, frame: came.append(number))
    with ours, theirs:
        timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGUSR1))
        timer.start()
        ended = streamed.turn.run(ours.fileno(), Limits(due_ns=time.perf_counter_ns() + LONG_NS))
        timer.join()
    signal.signal(signal.SIGUSR1, before)
    assert ring.WHY[ended] == "signalled"
    assert came == [signal.SIGUSR1]


def test_another_thread_can_stop_a_call_between_messages() -> None:
    streamed, clean = streaming()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        streamed.turn.stop()
        theirs.send(b"".join(clean))
        assert ring.WHY[streamed.turn.run(ours.fileno(), Limits(due_ns=0))] == "due"
        assert streamed.turn.end.messages == 0  # nothing was read


def test_the_other_end_goes() -> None:
    streamed, clean = streaming()
    ours, theirs = socket.socketpair()
    with ours:
        theirs.send(clean[0] + clean[1][:10])
        theirs.close()
        assert ring.WHY[streamed.turn.run(ours.fileno())] == "gone"
        assert (streamed.turn.end.messages, streamed.decoder.arrays[2][HELD]) == (1, 10)
    leader, follower = os.openpty()
    tty.setraw(follower)
    os.close(leader)
    assert ring.WHY[streamed.turn.run(follower)] == "gone"
    os.close(follower)


def test_a_command_that_cannot_be_sent_whole_is_left_to_the_caller() -> None:
    """The other end reads nothing: the kernel writes what fits, waits a bounded time, and says what is left."""
    _, bundle, plan = small_setup("host-driven")
    core = Core(plan, make_decider(bundle, backend="automaton"), 1, 0)
    core.warm_up()
    core.begin(0, 0)
    steps = core.steps(SESSION)
    drive = HostDriver(core, WalkPlace(plan, plan.automaton)).arrays(SESSION)
    turn = Kernel(steps, FrameDecoder(), drive)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                ours.send(bytes(64))
        turn.control[ring.FD], turn.control[ring.NEXT_ID], turn.control[ring.OLDEST_ID] = ours.fileno(), 5, 5
        turn.run()  # nothing has come
        turn.control[ring.FD], turn.control[ring.NEXT_ID] = ours.fileno(), 5
        scratch = np.zeros(4, np.int64)
        assert not called(answer.send_show)(steps.walk, drive, turn.rings, turn.control, scratch)
        size = int(turn.rings.shows[0, ring.END])
        assert 0 < turn.control[ring.UNSENT] <= size
        frame = FrameDecoder().feed(turn.rings.kept[:size].tobytes())[0]
        command = decode_command(frame.payload)
        assert (frame.session, command.command_id, command.opcode) == (SESSION, 5, Opcode.SHOW)
        assert unpack_command(Show, command.body)[:2] == (int(plan.slot_pattern[0] == DARK_PATTERN), 0)


def test_nothing_is_compiled_once_the_light_is_on(tmp_path: Path) -> None:
    """In a process of its own, where no other test has compiled anything: what kernels are called with is known before arming."""
    program = f"""
import sys
from pans.app.main import main
from pans.live import loop

def compiled():
    values = [one for name, module in list(sys.modules.items()) if name.startswith("pans") for one in vars(module).values()]
    return {{str(one): len(one.signatures) for one in values if hasattr(one, "signatures")}}

def lit(*arguments, original=loop._light_on):
    before = compiled()
    original(*arguments)
    print("CHANGED", [name for name, n in compiled().items() if n != before.get(name, n)])

loop._light_on = lit
for number, words in enumerate([
    ["demo", "--pace", "fast", "--trials", "1"],
    ["run", "fashion10", "--device", "sim:oled-qcmos?pace=fast", "--decisions", "50", "--shots", "2"],
    ["run", "fashion-adaptive", "--device", "sim:dmd-spad?scene=fashion200&pace=fast", "--drive", "host", "--decisions", "20"],
]):
    main([*words, "--out", {str(tmp_path)!r} + f"/{{number}}", "--no-realtime"])
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    lines = [line for line in found.stdout.splitlines() if line.startswith("CHANGED")]
    assert lines == ["CHANGED []"] * 3, (lines, found.stderr[-2000:])
