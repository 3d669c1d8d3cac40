"""What a connection does with answers; that bytes arrive is in test_contract.py."""

import pytest

from pans.live.session import Session
from pans.protocol.wire import messages as wire
from pans.protocol.wire.framing import FrameDecoder
from pans_sim.ports.serve import open_sim


@pytest.mark.parametrize(("held_ticks", "used"), [(0, True), (9_000, True), (11_000, False), (1 << 40, False)])
def test_an_answer_that_the_device_held_for_longer_than_it_was_away_is_not_used(held_ticks: int, used: bool) -> None:
    """Away for 1 ms, which is 10 000 ticks."""
    connection = Session(open_sim("sim:ideal?scene=uniform&pace=fast"))
    tick_hz = int(connection.handshake().facts["tick_hz"])
    clock, session = connection.known_clock(), connection.host
    sent_ns = connection.link.now_ns()
    session.probe(sent_ns)
    session.take_output()  # the simulator shall not answer
    held = held_ticks * tick_hz // 10_000_000
    (pong,) = FrameDecoder().feed(wire.encode_pong(wire.Pong(1, sent_ns, 5_000, 5_000 + held), session.nonce))
    assert not connection.sort(pong, sent_ns + 1_000_000)
    connection.take_pongs()
    assert (clock.n_probes, session.counters.implausible) == (int(used), int(not used))
    connection.close()
