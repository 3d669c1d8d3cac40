"""What the reference instrument is told before it starts: a profile and options as lines of text.

Owns the refusal of what the C engine does not have, and the units: everything is whole ticks, bytes and counts. The words are those of
firmware_sim/reference/posix/bench.c.
"""

from __future__ import annotations

import math

from pans.firmware_sim.device.gates import GATE_CHANNELS, MAX_PENDING_GATES
from pans.firmware_sim.device.states import MAX_SHOWS
from pans.firmware_sim.device.upload import MAX_PATTERN_PIXELS, MAX_SLOTS, MAX_UPLOAD_BYTES
from pans.firmware_sim.ports.serve import SimOptions
from pans.firmware_sim.scene.moving import SceneFile
from pans.firmware_sim.scene.still import Scene
from pans.runtime.errors import ConfigError
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.messages import MAX_PAYLOAD_BYTES

FIRMWARE = "pans-reference 1"
MAX_BUFFER_BYTES = 1 << 26  # of messages that are held back, however many may be
_BLOCK_FRAME_BYTES = MAX_PAYLOAD_BYTES + MAX_PAYLOAD_BYTES // 254 + 64


def settings_text(
    options: SimOptions, profile: Profile, scene: SceneFile, listen: str = "none", *, awake: bool = False
) -> str:
    """Return the lines, `start` the last of them; ConfigError for what the engine cannot show."""
    _check(profile, scene)
    lines = _settings(options, profile, scene, _numeric(listen), awake)
    return "".join(f"{name} {value}\n" for name, value in lines.items()) + "start\n"


def _settings(
    options: SimOptions, profile: Profile, scene: SceneFile, listen: str, awake: bool
) -> dict[str, int | str]:
    hz, projector, exposure = profile.clock.tick_hz, profile.projector, profile.exposure
    parallel = profile.mode == "parallel"
    return {
        "tick_hz": hz,
        "parallel": int(parallel),
        "channels": profile.detector.channels,
        "levels": projector.levels,
        "pattern_memory": projector.pattern_memory,
        "pattern_pixels": min(projector.width_px * projector.height_px, MAX_PATTERN_PIXELS),
        "pixel_memory": MAX_UPLOAD_BYTES // 2,
        "slot_memory": MAX_SLOTS,
        "automaton_states": 0 if parallel else projector.automaton_states,
        "dwell_steps": 0 if parallel else projector.dwell_steps,
        "show_memory": 0 if parallel else MAX_SHOWS,
        # a tick more or less is forgiven for rounding, as by the simulator in Python
        "exposure_min_ticks": max(1, round(exposure.min_us * hz / 1e6) - 1),
        "exposure_max_ticks": round(exposure.max_us * hz / 1e6) + 1,
        "readout_ticks": max(0, math.ceil(exposure.readout_us * hz / 1e6) - 1),
        "pattern_ticks": max(0, math.ceil(hz / projector.pattern_rate_max_hz) - 1),
        "turn_ticks": max(0, math.ceil(profile.timing.device_turn_us * hz / 1e6) - 1),
        "buffer_messages": options.buffer,
        "buffer_bytes": min(options.buffer * _BLOCK_FRAME_BYTES, max(MAX_BUFFER_BYTES, _BLOCK_FRAME_BYTES)),
        "gate_outputs": GATE_CHANNELS,
        "gate_pulses": MAX_PENDING_GATES,
        "epoch": 1,
        "offset_ticks": options.offset,
        "rate": 10**9 + round(options.drift_ppm * 1000),
        "objects": scene.n_objects,
        "seed": options.seed,
        "awake": int(awake),
        "listen": listen,
        "firmware": FIRMWARE,
        "serial": f"SIM-{options.seed & 0xFFFFFFFF:08X}",
        "profile": profile.name,
        "scene": _scene_words(scene),
    }


def _scene_words(scene: SceneFile) -> str:
    """The scene's name, and that its optics are not perfect where they are not; the engine takes some 60 bytes of text."""
    perfect = not isinstance(scene.what, Scene) or scene.what.imaging.is_identity
    return scene.name[:60] if perfect else f"{scene.name[:40]} (hidden optics)"


def _numeric(listen: str) -> str:
    """`tcp:PORT` as tcp:127.0.0.1:PORT."""
    kind, _, rest = listen.partition(":")
    return f"tcp:127.0.0.1:{rest}" if kind == "tcp" and rest.isdecimal() else listen.replace("localhost", "127.0.0.1")


def _check(profile: Profile, scene: SceneFile) -> None:
    """Refuse what the C engine cannot show."""
    if scene.moves:
        raise ConfigError(
            f"scene {scene.name!r} moves: the C engine shows still objects",
            remedy="leave --engine out",
        )
    if scene.changes:
        raise ConfigError(
            f"{scene.name!r} changes, or the source or the readings of {profile.name} do: not on the C engine",
            remedy="leave --engine out",
        )
    detector = profile.detector
    if detector.afterpulse_time_us or detector.crosstalk_further:
        raise ConfigError(
            f"{profile.name} states afterpulse_time_us or crosstalk_further: the C engine looks one exposure and one channel back",
            remedy="leave --engine out",
        )
    if profile.projector.dwell_steps > 1 and (detector.read_noise_e or detector.threshold_e > 1):
        raise ConfigError(
            f"{profile.name} has read noise and dwell steps: the C engine knows the click law of short light without noise only",
            remedy="leave --engine out",
        )
