"""`pans simulate --engine c`: the compiler, what is refused, and real runs against the reference instrument over a pty and TCP."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from c_device import MODES, needs_compiler, small_scene

from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.engine import CEngine, build, engine_program
from pans.firmware_sim.engine.settings import settings_text
from pans.firmware_sim.ports.serve import SimOptions, build_instrument, parse_sim_url
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.firmware_sim.scene.scene_file import open_scene
from pans.firmware_sim.testing import following_profile, small_setup
from pans.runtime.bundle.model import Bundle
from pans.runtime.core.plan import build_plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import ConfigError, UsageError
from pans.runtime.instrument.profile import Profile, load_profile
from pans.runtime.link.base import Link, open_link
from pans.runtime.live import RunOptions, run_live
from pans.runtime.record import Recorder, read_recording, replay
from pans.runtime.report.summary import Summary, summarise
from pans.runtime.wire import messages as wire

posix = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")


def setup(mode: str) -> tuple[Profile, Bundle]:
    """A profile and a bundle that run in `mode` at real pace: a host that names states gets the time for it."""
    profile, bundle, _ = small_setup(mode)
    if mode == "host-driven":
        projector = replace(profile.projector, automaton_states=0)
        profile = replace(profile, projector=projector, timing=replace(profile.timing, host_turn_us=20_000.0))
    return profile, bundle


# -- before anything runs ----------------------------------------------------------------------------------------------


def test_the_engine_is_a_key_of_the_url_and_refuses_what_it_has_not() -> None:
    assert parse_sim_url("sim:ideal?engine=c").engine == "c"
    for rest in ("engine=d", "engine=c&pace=fast", "engine=c&faults=loss:0.1", "engine=c&changes=dark:at_s=1:factor=2"):
        with pytest.raises(UsageError, match="engine"):
            parse_sim_url(f"sim:ideal?{rest}")
    with pytest.raises(UsageError, match="not for an instrument in this process"):
        build_instrument(SimOptions("ideal", engine="c"), 0)


def test_scenes_that_move_and_noise_with_short_light_are_refused() -> None:
    with pytest.raises(ConfigError, match="moves"):
        settings_text(SimOptions("wdm-snspd"), load_profile("wdm-snspd"), open_scene("cells-in-flow"))
    profile = following_profile()
    noisy = replace(profile, detector=replace(profile.detector, read_noise_e=0.2))
    with pytest.raises(ConfigError, match="read noise"):
        settings_text(SimOptions("ideal"), noisy, open_scene("uniform"))


def test_without_a_compiler_the_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="no C compiler") as caught:
        engine_program()
    assert "--engine" in str(caught.value)
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(ConfigError, match="no-such-compiler"):
        engine_program()


@needs_compiler
def test_a_program_is_built_once_and_anew_for_other_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    first = engine_program()
    made = first.stat().st_mtime_ns
    assert engine_program() == first
    assert first.stat().st_mtime_ns == made
    folder = tmp_path / "sources"
    for path in build.FOLDER.rglob("*.[ch]"):
        copy = folder / path.relative_to(build.FOLDER)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    assert engine_program(folder) == first
    (folder / "crc.c").write_text((folder / "crc.c").read_text() + "/* changed */\n")
    assert engine_program(folder) != first
    (folder / "crc.c").write_text("no C at all\n")
    with pytest.raises(ConfigError, match="could not build"):
        engine_program(folder)
    assert len(list((tmp_path / "cache" / "pans").iterdir())) == 2, "a build that failed left something"


# -- real runs ---------------------------------------------------------------------------------------------------------


def carried_out(link: Link, profile: Profile, bundle: Bundle, objects: int, path: Path) -> tuple[Summary, int]:
    """Run `bundle` on `link` as `pans run` does, one decision for each of `objects`, into a recording.

    Returns the summary, and how many slots stayed dark because the host named their state too late.
    """
    plan = build_plan(profile, bundle)
    backend = "table" if bundle.automaton is None else "automaton"
    decider = make_decider(bundle, shots=1, backend=backend)
    config = RunOptions(n_cycles=objects * plan.cycles_per_object, deadline_us=1e6, realtime=False)
    core = Core(plan, decider, 1, config.n_cycles)
    told = {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": backend, "drive": plan.drive, "confidence": 0.0}
    with Recorder(path, {"config": told}) as recorder:
        result = run_live(link, profile, bundle, plan, core, config, recorder)
        summary = summarise(result, illumination=1.0, expected_decisions=objects)
        recorder.close(summary.as_json())
    return summary, result.late_slots


def on_c(mode: str, listen: str, objects: int, path: Path) -> tuple[Summary, int]:
    profile, bundle = setup(mode)
    engine = CEngine(SimOptions("ideal", seed=5), listen, profile=profile, scene=small_scene())
    try:
        link = open_link(engine.url)
        try:
            return carried_out(link, profile, bundle, objects, path)
        finally:
            link.close()
            assert engine.running
    finally:
        engine.close()
        assert not engine.running


def in_python(mode: str, objects: int, path: Path) -> None:
    profile, bundle = setup(mode)
    clock = DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, small_scene(), seed=5, power_on_tick=clock.tick_at(START_NS))
    carried_out(VirtualLink(device, clock, "python"), profile, bundle, objects, path)


def decided(path: Path) -> list[tuple[int, ...]]:
    """Every decision without its times."""
    rows = read_recording(path).decisions()
    assert rows.dtype.names is not None
    names = [name for name in rows.dtype.names if "tick" not in name and "ns" not in name]
    return [tuple(row[name].item() for name in names) for row in rows]


@needs_compiler
@posix
@pytest.mark.parametrize(("mode", "listen"), [*((mode, "tcp:127.0.0.1:0") for mode in MODES), ("sequential", "pty")])
def test_a_real_run_decides_what_the_simulator_in_python_decides(mode: str, listen: str, tmp_path: Path) -> None:
    made, late_slots = on_c(mode, listen, 24, tmp_path / "c.pansrec")
    summary = made.as_json()
    recording = read_recording(tmp_path / "c.pansrec")
    assert replay(recording, setup(mode)[1]).sha256 == recording.decisions_sha256
    stream = summary["stream"]
    assert summary["device"]["firmware"].startswith("pans-reference")
    assert (summary["decisions"], summary["contradictions"]) == (24, {})
    assert (stream["lost_exposures"], stream["device_drops"], stream["malformed"]) == (0, 0, 0)
    assert summary["wrong_patterns"] == late_slots
    # a host that names states may be stopped by the machine: then slots stay dark, and its walks are other ones
    if not late_slots:
        in_python(mode, 24, tmp_path / "python.pansrec")
        assert decided(tmp_path / "c.pansrec") == decided(tmp_path / "python.pansrec")


@needs_compiler
def test_the_command_serves_until_the_process_that_started_it_ends() -> None:
    words = [sys.executable, "-m", "pans.firmware_sim", "--profile=ideal", "--scene=uniform", "--engine=c"]
    child = subprocess.Popen(
        [*words, "--listen=tcp:127.0.0.1:0", "--until-stdin-closes"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdout is not None
    assert child.stdin is not None
    url = child.stdout.readline().decode().strip()
    link = open_link(url)
    link.write(wire.encode_hello(9))
    found = wire.FrameDecoder().feed(link.read(5.0))
    link.close()
    child.stdin.close()
    assert child.wait(10.0) == 0
    assert wire.decode_welcome(found[0].payload).facts["firmware"] == "pans-reference 1"
