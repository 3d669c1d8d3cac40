"""The two devices side by side, and the commands that bring them a plan: for the tests of the reference instrument."""

from __future__ import annotations

import random
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from c_core import COMPILER, CDevice

from pans.live.device_check import upload_commands
from pans.protocol.wire import Frame, MessageType, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, pack_command
from pans_sim.device.instrument import Instrument
from pans_sim.scene.moving import SceneFile
from pans_sim.scene.still import scene_from_arrays
from pans_sim.testing import small_setup

MODES = ("sequential", "parallel", "device-driven", "host-driven")
NONCE = 7
needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler on this machine")


def small_scene() -> SceneFile:
    """Six objects of 2 x 2 pixels and three classes."""
    images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
    return SceneFile("six", scene_from_arrays("six", images, np.arange(6) % 3, ("a", "b", "c")))


class Pair:
    """The simulator's instrument and the C core, which hear the same bytes at the same ticks; `heard` is what each said.

    `dead` is the dead time of their detectors, in exposures.
    """

    def __init__(self, mode: str, *, seed: int = 3, buffer: int = 256, dead: float = 0.0) -> None:
        self.profile, self.bundle, self.plan = small_setup(mode)
        blinded = {"dead_time_ns": 1000 * dead * self.plan.exposure_us, "between_exposures": "free-running"}
        blinded["photon_number_max"] = 1  # the C core tells clicks
        self.profile = replace(self.profile, detector=replace(self.profile.detector, **blinded))
        scene = small_scene()
        self.devices = (
            Instrument(self.profile, scene, seed=seed, buffer_messages=buffer),
            CDevice(self.profile, scene, seed=seed, buffer=buffer),
        )
        self.heard: tuple[list[Frame], list[Frame]] = ([], [])
        self._decoders = (wire.FrameDecoder(), wire.FrameDecoder())
        self.tick = self.last_id = 0

    def after(self, ticks: int, data: bytes = b"") -> None:
        """Let time pass, then hand over `data`."""
        self.tick += ticks
        for device, decoder, heard in zip(self.devices, self._decoders, self.heard):
            heard += decoder.feed(device.step(self.tick, data))

    def command(self, opcode: int, body: bytes, ticks: int = 20) -> None:
        """Send the next command."""
        self.last_id += 1
        self.after(ticks, wire.encode_command(self.last_id, opcode, body, NONCE))

    def open(self, upload: bool = True) -> None:
        """Begin a session, and upload the plan."""
        self.last_id = 0
        self.after(10, wire.encode_hello(NONCE))
        facts = next(wire.decode_welcome(f.payload).facts for f in self.heard[0] if f.type == MessageType.WELCOME)
        for opcode, body in upload_commands(self.plan, self.bundle, facts) if upload else ():
            self.command(opcode, body)

    def arm(self, cycles: int, lease_ms: int = 5000, window: int = 1 << 20) -> None:
        """Grant and arm, for a start 5000 ticks ahead."""
        self.after(1, wire.encode_grant(wire.Grant(window, lease_ms), NONCE))
        self.command(Opcode.ARM, pack_command(Arm(self.tick + 5000, cycles, lease_ms)))

    def differences(self) -> list[str]:
        """Kinds of messages that the two have not sent alike; the texts of refusals and of WELCOME are each device's own."""
        ours, theirs = (sent_by_kind(heard) for heard in self.heard)
        return [f"{kind:#04x}: {ours[kind]} and {theirs[kind]}" for kind in ours | theirs if ours[kind] != theirs[kind]]


def sent_by_kind(heard: list[Frame]) -> defaultdict[int, list[str]]:
    """Payloads by type, in hex, as far as two devices must agree."""
    found: defaultdict[int, list[str]] = defaultdict(list)
    for frame in heard:
        found[frame.type].append(frame.payload[: {MessageType.ACK: 14, MessageType.WELCOME: 8}.get(frame.type)].hex())
    return found


def strange_frames(seed: int, pair: Pair, count: int) -> list[bytes]:
    """Commands in and out of order, grants, probes and HELLOs, with numbers at the edges."""
    dice = random.Random(seed)
    frames = []
    for _ in range(count):
        number = dice.choice((0, 1, 2, 5, 255, 65535, 1 << 20, (1 << 32) - 1, dice.getrandbits(32)))
        body = dice.choice((b"", dice.randbytes(dice.choice((1, 8, 12, 16, 24, 36, 48)))))
        kinds = {
            0: wire.encode_hello(NONCE + dice.randrange(2)),
            1: wire.encode_ping(number, number, NONCE),
            2: wire.encode_grant(wire.Grant(number, number), NONCE),
            3: wire.encode_command(max(0, pair.last_id + dice.randrange(-1, 3)), dice.randrange(12), body, NONCE),
            4: wire.encode_command(number, dice.randrange(12), body, NONCE + dice.randrange(2)),
            5: dice.randbytes(dice.randrange(1, 40)),
        }
        frames.append(kinds[dice.choices(range(6), (1, 4, 4, 20, 4, 1))[0]])
    return frames
