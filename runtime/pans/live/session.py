"""`Session`: the link, what was agreed on it, and the device's clock; it ends with the link.

`open_session` brings a device to where ARM can follow: handshake, check, upload, clock. Each of these steps returns when the device has
agreed, or raises LinkError (it is silent or gone) or DeviceError (it refused). `pump` reads, decodes, answers and sends. Of an armed run
receiver.py takes the bytes. What is sent is sent here, except the next SHOW of the kernel.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Any

from pans.base.errors import DeviceError, LinkError, PansError
from pans.bundle.sensor import Bundle
from pans.decide.plan import Plan
from pans.live.timing.causes import Evidence, Stamped
from pans.protocol.clock import ClockModel, ClockStep
from pans.protocol.links import Chunk, Link, LinkReader
from pans.protocol.session import ANSWER_TYPES, HostSession
from pans.protocol.wire import (
    Arm,
    DeviceState,
    Frame,
    FrameDecoder,
    Opcode,
    Welcome,
    pack_body,
    pack_command,
    wrong_facts,
)
from pans.record.recorder import Recorder

from .device_check import check_device, check_scene, upload_commands
from .job import Job

NS_PER_S = 1_000_000_000
# for ARM and GRANT to arrive, one retransmission, and a host that does not run for some 50 ms
ARM_LEAD_NS = NS_PER_S // 10
RECEIVE_WINDOW = 4096  # stream messages
SETUP_POLL_S = 0.02
CLOCK_BURST = 16
PROBE_GIVE_UP_NS = NS_PER_S // 4  # of one probe of the burst: a lost one is not waited for


class Session:
    """Link, reader, decoder, session and clock of one session.

    For the recording: `on_sent` sees every outgoing byte string, `on_answer` the header and payload of every WELCOME, ACK and PONG.
    """

    def __init__(
        self,
        link: Link,
        on_sent: Callable[[int, bytes], None] | None = None,
        on_answer: Callable[[int, bytes], None] | None = None,
    ) -> None:
        self.link = link
        self.reader = LinkReader(link)
        self.decoder = FrameDecoder()
        self.host = HostSession(secrets.randbelow(0xFFFFFFFF) + 1)
        self.clock: ClockModel | None = None
        self.clock_steps: list[ClockStep] = []  # since the last look
        self.evidence: Evidence | None = None  # of what makes work late, once a run wants it
        self.on_sent, self.on_answer = on_sent, on_answer
        self.armed = False  # ARM was sent
        self.delivered = 0  # messages for the core
        self.taken = 0  # those of them that it was given, or that came before ARM
        self.answers = 0  # frames that were the session's alone
        self.broken: LinkError | None = None  # met while acting, kept until all that has arrived is decided
        self.counted = False  # its counters are in the accounts
        self._granted_until = 0  # stream messages
        self._failure: PansError | None = None  # met while digesting, kept until all that came with it is delivered

    def pump(self, timeout_s: float) -> None:
        """Send what is due, wait at most `timeout_s` for bytes, and digest them."""
        came = self._digest_all(self.chunks(timeout_s))
        self.take_pongs()
        if not came:
            self.raise_failure()

    def send_due(self) -> bool:
        """Send what is due and return whether that was anything; raises what the latest frames ended the session with."""
        self.raise_failure()
        self.host.poll(self.link.now_ns())
        return self.flush()

    def chunks(self, timeout_s: float, *, asked: bool = False) -> list[Chunk]:
        """Send what is due and return what has been read, waiting at most `timeout_s` for it; `asked`: an answer is due at once."""
        asked |= self.send_due()
        began_ns = self.link.now_ns()
        chunks = self.reader.wait(timeout_s, eager=asked)
        if self.evidence is not None:
            self.evidence.waited(began_ns, began_ns + int(timeout_s * 1e9), self.link.now_ns())
            for chunk in chunks:
                self.evidence.arrived(chunk.arrival_ns)
        return chunks

    def rest(self) -> None:
        """Stop reading and digest what has arrived and was never taken: a host finds it that stood still while its device was lost."""
        self._digest_all(self.reader.rest())

    def _digest_all(self, chunks: list[Chunk]) -> bool:
        """Digest chunks; return whether anything of them would be a core's."""
        before = self.delivered
        for chunk in chunks:
            for frame in self.decoder.feed(chunk.data):
                self.sort(frame, chunk.arrival_ns)
        return self.delivered > before

    def raise_failure(self) -> None:
        """Raise what ended the session, once all that came with it has been delivered."""
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def take_pongs(self) -> None:
        """Give the clock what came for it."""
        while self.clock is not None and self.host.pongs:
            pong, arrival_ns = self.host.pongs.popleft()
            if not self.clock.can_be(pong.host_ns, pong.rx_tick, pong.tx_tick, arrival_ns):
                self.host.counters.implausible += 1
                continue
            step = self.clock.add_probe(pong.host_ns, pong.rx_tick, pong.tx_tick, arrival_ns)
            if step is not None:
                self.clock_steps.append(step)
            if self.evidence is not None:
                reached_ns, left_ns = (self.clock.to_host_ns(tick)[0] for tick in (pong.rx_tick, pong.tx_tick))
                self.evidence.stamped(Stamped(pong.host_ns, reached_ns, left_ns, arrival_ns))

    def sort(self, frame: Frame, arrival_ns: int) -> bool:
        """Give a frame to the session and return whether it is the core's too; an answer is on record before it can end the session.

        What ends the session waits until the frames that came with it are delivered.
        """
        if self.on_answer is not None and frame.type in ANSWER_TYPES:
            self.on_answer(arrival_ns, pack_body(frame))
        is_cores = self.digest(frame, arrival_ns)
        self.delivered += is_cores
        self.answers += not is_cores
        return is_cores

    def digest(self, frame: Frame, arrival_ns: int) -> bool:
        """Give a frame to the session, which is on record and counted, and return whether it is the core's too."""
        try:
            is_cores = self.host.on_frame(frame, arrival_ns)
        except PansError as error:
            self._failure, is_cores = self._failure or error, False
        return is_cores

    def flush(self) -> bool:
        """Send what the session has to say; return whether that was anything."""
        data = self.host.take_output()
        if data:
            self.link.write(data)
            if self.on_sent is not None:
                self.on_sent(self.link.now_ns(), data)
        return bool(data)

    @property
    def facts(self) -> dict[str, Any]:
        """What the device says of itself; empty before the handshake."""
        return {} if self.host.welcome is None else dict(self.host.welcome.facts)

    @property
    def is_dark(self) -> bool:
        """Whether the device has said that it is dark."""
        status = self.host.status
        return status is not None and status.state in (DeviceState.IDLE, DeviceState.SAFE)

    def handshake(self) -> Welcome:
        """Open the session and return what the device says of itself; the device leaves SAFE if it was latched there."""
        self.host.start(self.link.now_ns())
        try:
            while self.host.welcome is None:
                self.pump(SETUP_POLL_S)
        except LinkError as error:
            if isinstance(error, DeviceError) or not self.link.is_shared():
                raise
            raise LinkError(
                f"{self.link.name} is in use by another program, and answers one at a time: {error.message}",
                remedy="end the other program, or name another device",
            ) from error
        welcome = self.host.welcome
        if wrong := wrong_facts(welcome.facts):
            raise DeviceError(
                f"the device's WELCOME: {'; '.join(wrong)}", remedy="see docs/reference/protocol.md, section 3"
            )
        self.clock = ClockModel(int(welcome.facts["tick_hz"]))
        self.host.submit(Opcode.RESET)
        self.wait_acknowledged()
        return welcome

    def wait_acknowledged(self) -> None:
        """Wait until every command has been acknowledged."""
        while self.host.in_flight:
            self.pump(SETUP_POLL_S)

    def upload(self, plan: Plan, bundle: Bundle) -> None:
        """Send the patterns, the plan and its automaton's states, and wait until the device has them."""
        for opcode, body in upload_commands(plan, bundle, self.facts):
            while not self.host.has_room:
                self.pump(SETUP_POLL_S)
            self.host.submit(opcode, body)
        self.wait_acknowledged()

    def synchronise(self) -> ClockModel:
        """Measure the device clock with a burst of probes and return the model; LinkError when none is answered."""
        clock = self.known_clock()
        for _ in range(CLOCK_BURST):
            wanted = clock.n_probes + 1
            now_ns = self.link.now_ns()
            self.host.probe(now_ns)
            while clock.n_probes < wanted and self.link.now_ns() - now_ns < PROBE_GIVE_UP_NS:
                self.pump(SETUP_POLL_S)
        if clock.n_probes == 0:
            raise LinkError("the device answered no clock probe", remedy="check that its firmware answers PING")
        return clock

    def known_clock(self) -> ClockModel:
        """Return the clock model, which exists from the handshake on; LinkError before it."""
        if self.clock is None:
            raise LinkError("the device's clock is not known before the handshake")
        return self.clock

    # -- of an armed run -----------------------------------------------------------------------------------------------

    def arm(self, arm: Arm) -> None:
        """Ask for exposures from an absolute device tick on; what comes from here on is the core's."""
        if not self.armed:
            self.armed, self.taken = True, self.delivered
        self.host.submit(Opcode.ARM, pack_command(arm))

    def granted(self, next_seq: int) -> int:
        """Return how many messages from `next_seq` on the device may send before the next grant is due."""
        return self._granted_until - next_seq - RECEIVE_WINDOW // 2

    def grant(self, next_seq: int, lease_ms: int) -> None:
        """Renew the lease, and let the device send RECEIVE_WINDOW messages from `next_seq` on."""
        self._granted_until = next_seq + RECEIVE_WINDOW
        self.host.grant(self._granted_until, lease_ms)

    def note_broken(self, error: LinkError) -> None:
        """Keep why nothing more can be sent until all that has arrived is decided."""
        self.broken = self.broken or error

    def raise_broken(self) -> None:
        """Raise why nothing more can be sent, once."""
        broken, self.broken = self.broken, None
        if broken is not None:
            raise broken

    def detach(self) -> None:
        """Stop reading and leave the link as it is, for whoever opens it again."""
        self.reader.stop()

    def close(self) -> None:
        """Close the link and its reader."""
        self.reader.close()


def open_session(
    link: Link,
    job: Job,
    recorder: Recorder | None,
    failed: Callable[[Session], object],
    uploaded: Callable[[], None] | None = None,
) -> Session:
    """Open a session, check that it is the right device, and bring it to where ARM can follow; `failed` is told of one that breaks.

    `uploaded` is called when the device has the plan: what is compiled elsewhere meanwhile can be waited for.
    """
    session = Session(link) if recorder is None else Session(link, recorder.add_command, recorder.add_answer)
    try:
        facts = session.handshake().facts
        check_device(facts, job.plan, job.bundle, job.profile.clock.tick_hz)
        check_scene(facts, job.bundle)
        session.upload(job.plan, job.bundle)
        if uploaded is not None:
            uploaded()
        session.synchronise()
    except BaseException:
        session.detach()
        failed(session)
        raise
    return session
