"""Whole runs through the kernel: at real pace over every kind of link, under faults, and as the core alone would make them."""

import os
import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fault_grid import MODES, run_case
from links import served
from tree import ROOT

from pans.base.errors import RecordingError
from pans.bundle.backends.choose import make_decider
from pans.decide.kernel import receive
from pans.decide.kernel.calls import Kernel
from pans.decide.still.core import Core
from pans.live.loop import NO_OBSERVERS, Job, Observers, Recovery, RunResult, run_live
from pans.live.options import RunOptions
from pans.live.session import Session
from pans.protocol.links.base import open_link
from pans.protocol.session import HostSession
from pans.record.reading import read_recording
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.faults import parse_faults
from pans_sim.ports.faulty import FaultyDevice
from pans_sim.ports.virtual import START_NS, VirtualLink
from pans_sim.scene.still import scene_from_arrays
from pans_sim.testing import small_setup

OBJECTS = 12


class Served:
    """A simulated instrument for `mode` in a thread, behind a real port."""

    def __init__(self, mode: str, listen: str, faults: str = "") -> None:
        self.profile, self.bundle, self.plan = small_setup(mode)
        clock = DeviceClock(self.profile.clock.tick_hz)
        tick = clock.tick_at(time.perf_counter_ns())
        device: Any = instrument(self.profile, tick)
        if faults:
            device = FaultyDevice(lambda _, tick: instrument(self.profile, tick), clock, parse_faults(faults), 1, tick)
        self._running = served(device, clock, listen)
        self.url = self._running.__enter__().url

    def close(self) -> None:
        self._running.__exit__(None, None, None)


def instrument(profile: Any, tick: int) -> Instrument:
    images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
    scene = scene_from_arrays("turn", images, np.arange(6) % 3, ("a", "b", "c"))
    return Instrument(profile, scene, seed=3, power_on_tick=tick)


def recorded(
    setup: Any, link: Any, path: Path, observers: Any = NO_OBSERVERS, objects: int = OBJECTS
) -> tuple[RunResult, Any]:
    backend = "table" if setup.bundle.automaton is None else "automaton"
    decider = make_decider(setup.bundle, shots=1, backend=backend)
    config = RunOptions(n_cycles=objects * setup.plan.cycles_per_object, deadline_us=1e9, realtime=False)
    core = Core(setup.plan, decider, 1, config.n_cycles)
    driven = {"drive": setup.plan.drive, "confidence": 0.0}
    facts = {"config": {"shots": 1, "tick_hz": setup.profile.clock.tick_hz, "backend": backend, **driven}}
    with Recorder(path, facts) as recorder:
        recovery = None if link.virtual else Recovery.of(link, setup.url, 10.0)  # a busy machine may arm too late
        result = run_live(
            link, Job(setup.profile, setup.bundle, setup.plan, config), core, recorder, recovery, observers
        )
        recorder.close({})
    return result, read_recording(path)


@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven", "host-driven"])
@pytest.mark.parametrize("listen", ["tcp:127.0.0.1:0", "pty", "usb"])
def test_a_run_at_real_pace(mode: str, listen: str, tmp_path: Path) -> None:
    """Through a descriptor, and through pyusb, whose bytes Python reads and sends."""
    setup = Served(mode, "tcp:127.0.0.1:0" if listen == "usb" else listen)
    if listen == "usb":
        setup.url = f"simusb:{setup.url.removeprefix('serial:')}"
    result, recording = recorded(setup, open_link(setup.url), tmp_path / "a.pansrec")
    setup.close()
    assert result.ended == "completed"
    assert ("no descriptor" in result.realtime["turn"]) == (listen == "usb")
    assert result.tally.decisions == OBJECTS * setup.plan.shots_per_cycle * setup.plan.cycles_per_object
    assert not result.contradictions  # every frame is an answer or was taken
    again = replay(recording, setup.bundle)
    assert (again.as_recorded, again.decisions) == (True, result.tally.decisions)
    decisions = recording.decisions()
    assert result.timing.total.total == len(decisions) or mode == "host-driven"
    if mode == "host-driven":
        assert sum(1 for _ in recording.commands()) > OBJECTS  # more than the first state of each walk was named
        assert result.turn_us["max"] > 0
    else:
        assert not decisions["flags"].any()


def test_answers_are_on_record_in_the_order_in_which_they_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that only Python can take, as a second answer to a command that the kernel has sent, among many that the kernel takes."""
    monkeypatch.setattr("pans.live.loop.PROBE_EVERY_NS", 1_000_000)
    setup = Served("host-driven", "tcp:127.0.0.1:0", "duplicate:0.03")
    _, recording = recorded(setup, open_link(setup.url), tmp_path / "a.pansrec", objects=60)
    setup.close()
    came = [at_ns for at_ns, _ in recording.answers()]
    assert len(came) > OBJECTS  # on a busy machine fewer probes are sent
    assert came == sorted(came)


def test_a_recording_that_fails_counts_nothing_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    setup, runs = Served("sequential", "tcp:127.0.0.1:0"), list[Any]()

    def full(recorder: Recorder, rows: Any) -> None:
        raise RecordingError("no space is left")

    monkeypatch.setattr(Recorder, "add_decisions", full)
    try:
        with pytest.raises(RecordingError, match="no space"):
            recorded(setup, open_link(setup.url), tmp_path / "run.pansrec", Observers(prepared=runs.append))
    finally:
        setup.close()
    assert runs[0].stopped
    assert runs[0].accounts.contradictions == {}


def test_a_probe_of_the_clock_leaves_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has its time when it is made: a wait before it is sent would count as its way to the device."""
    told: list[str] = []
    for owner, name in ((HostSession, "probe"), (Session, "flush"), (Kernel, "run")):
        original = getattr(owner, name)

        def noted(*arguments: Any, name: str = name, original: Any = original, **options: Any) -> Any:
            found = original(*arguments, **options)
            if name != "flush" or found:  # something was sent
                told.append(name)
            return found

        monkeypatch.setattr(owner, name, noted)
    setup = Served("sequential", "tcp:127.0.0.1:0")
    recorded(setup, open_link(setup.url), tmp_path / "a.pansrec")
    setup.close()
    later = told[told.index("run") :]
    assert {after for what, after in pairwise(later) if what == "probe"} == {"flush"}


@pytest.mark.parametrize("acts", [True, False])
@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven", "host-driven"])
def test_a_core_alone_leaves_the_same(mode: str, acts: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In virtual time, with the kernel and without: decisions, messages and figures; of a watcher that acts also all times."""
    profile, bundle, plan = small_setup(mode)
    found = []
    for alone in (True, False):
        if alone:
            monkeypatch.setattr(Core, "takes", False)
        else:
            monkeypatch.undo()
        clock = DeviceClock(profile.clock.tick_hz)
        device = instrument(profile, clock.tick_at(START_NS))
        setup = SimpleNamespace(profile=profile, bundle=bundle, plan=plan)
        observers = Observers(lambda run, output: None, acts=acts)
        link = VirtualLink(device, clock, "sim:turn")
        found.append(recorded(setup, link, tmp_path / str(alone), observers))
    (ours, ours_recorded), (theirs, theirs_recorded) = found
    assert ours.tally.figures() == theirs.tally.figures()
    np.testing.assert_array_equal(ours.tally.confusion, theirs.tally.confusion)
    assert ours.stream == theirs.stream
    for name in ("total", *ours.timing.stages) if acts else ():
        one, other = (result.timing.stages.get(name, result.timing.total) for result in (ours, theirs))
        assert (one.counts.tolist(), one.total, one.max_ns) == (other.counts.tolist(), other.total, other.max_ns)
    assert (ours.timing.late, ours.timing.blame) == (theirs.timing.late, theirs.timing.blame)
    assert (ours.slot_jitter_us, ours.dark) == (theirs.slot_jitter_us, theirs.dark)
    for which in ("decisions", "timings") if acts else ("decisions",):
        assert getattr(ours_recorded, which)().tolist() == getattr(theirs_recorded, which)().tolist()
    assert [body[8:] for _, body in ours_recorded.messages()] == [body[8:] for _, body in theirs_recorded.messages()]


@pytest.mark.parametrize("seed", range(len(MODES)))
def test_runs_under_all_faults_are_sound(seed: int) -> None:
    """The quick form of the fault grid: every kind of plan for objects that stand still, judged from outside."""
    assert run_case("all", seed, 1200).violations == []


@pytest.mark.parametrize("case", ["late", "host_stop", "pause"])
def test_a_host_that_drives_and_asks_for_pulses_uses_each_number_once(case: str) -> None:
    """Where a watcher asks for a pulse, the kernel's next SHOW has the number behind it."""
    assert run_case(case, MODES.index("host-driven"), 1200).violations == []


def test_each_kernel_is_compiled_once_and_loaded_from_the_cache() -> None:
    """After this module's runs: the turn once for each kind of walk. A fresh process finds it in the cache, though it calls libc."""
    kinds = [kind for one in receive.turn.signatures for kind in re.findall(r"\b(?:Frame)?WalkArrays\b", str(one))]
    assert sorted(kinds) == ["FrameWalkArrays", "WalkArrays"]
    code = (
        "import test_calls as t; from pans.decide.kernel import turn;"
        "s, c = t.streaming(); n = sum(len(b.rows) for b in s.feed(b''.join(c)));"
        "print(n, sum(turn.stats.cache_hits.values()), sum(turn.stats.cache_misses.values()))"
    )
    here = Path(__file__).parent
    paths = [here, *(ROOT / "tests" / name for name in ("support", "oracles", "sessions", "independent"))]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True)
    assert done.stdout.split() == ["4", "1", "0"]
