"""A flow in whole runs, in virtual time and over a descriptor: recording, pulses and figures."""

from __future__ import annotations

import random
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from links import served

from pans.firmware_sim.ports.serve import build_instrument, open_sim, parse_sim_url
from pans.runtime.bundle.model import load_bundle
from pans.runtime.decide.backends import make_decider
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.make import plan_flow
from pans.runtime.flow.settings import FlowSettings
from pans.runtime.instrument.profile import load_profile
from pans.runtime.link import connection
from pans.runtime.link.base import open_link
from pans.runtime.live import Observers, Recovery, RunOptions, run_live
from pans.runtime.live.dark_run import DarkRun
from pans.runtime.live.flow_run import FlowRun
from pans.runtime.record import Recorder, read_recording
from pans.runtime.record.replaying import replay

PROFILE = load_profile("flow-snspd")
SETTINGS = FlowSettings("cells", fields_per_s=20_000.0, onset_frames=4, gate_classes=("a", "b"))


def run(folder: Path, settings: FlowSettings, link: Any, seconds: float, url: str = "") -> tuple[Any, ...]:
    bundle = load_bundle(folder / "thirds.pans")[0]
    plan, core, cycles = plan_flow(PROFILE, bundle, make_decider(bundle), settings, 1, seconds)
    dark = DarkRun.of(RunOptions(), PROFILE)
    core.guard = dark.guard(plan, bundle, 1, flow=True)
    flow, path = FlowRun(core, None), folder / "run.pansrec"
    config = RunOptions(n_cycles=cycles, deadline_us=1e9, realtime=False)
    facts = {"shots": 1, "tick_hz": PROFILE.clock.tick_hz, "backend": "table", "confidence": 0.0, "dark": dark.header()}
    with Recorder(path, {"config": facts | {"flow": flow.header()}}, overwrite=True) as recorder:
        recovery, observers = Recovery.of(link, url, 10.0), Observers(prepared=flow.prepared)
        result = run_live(link, PROFILE, bundle, plan, core, config, recorder, recovery, observers)
        recorder.close({})
    return result, flow.figures().as_json(), read_recording(path), bundle


@pytest.mark.parametrize("dark_every", [0, 2])
@pytest.mark.parametrize("faults", ["", "loss:0.01,flip:0.01,duplicate:0.01,truncate:0.01,reorder:0.01,drip:0.01"])
def test_the_core_alone_leaves_the_same(
    faults: str, dark_every: int, flow_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decisions, times, events, figures, messages and pulses, byte for byte, with the kernel and without."""
    told = []
    for alone in (True, False):
        numbers = random.Random(7)
        monkeypatch.setattr(connection, "secrets", SimpleNamespace(randbelow=numbers.randrange))
        if alone:
            monkeypatch.setattr(FlowCore, "takes", False)
        else:
            monkeypatch.undo()
            monkeypatch.setattr(connection, "secrets", SimpleNamespace(randbelow=random.Random(7).randrange))
        link = open_sim(f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=4&pace=fast&faults={faults}")
        settings = replace(SETTINGS, dark_every=dark_every)
        result, figures, recording, _ = run(flow_folder, settings, link, 0.05)
        assert result.ended == "completed"
        told.append(
            {
                "decisions": recording.decisions().tolist(),
                "timings": recording.timings().tolist(),
                "messages": list(recording.messages()),
                "commands": list(recording.commands()),
                "events": list(recording.events()),
                "figures": figures,
                "tally": result.tally.figures(),
                "stream": result.stream,
                "dark": result.dark,
                "late": (result.timing.late, result.timing.blame),
            }
        )
    assert told[1]["figures"]["gates"]["done"] > 5
    for key, found in told[0].items():
        assert found == told[1][key], key


@pytest.mark.parametrize("usb", [False, True])
def test_a_run_at_real_pace(flow_folder: Path, usb: bool) -> None:
    """Through a descriptor or pyusb: pulses leave behind the record of their decisions, and a replay decides
    the same.
    """
    url = f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=3"
    device, clock = build_instrument(parse_sim_url(url), time.perf_counter_ns())
    settings = replace(SETTINGS, gate_delay_us=400_000.0)  # a busy machine makes it
    with served(device, clock) as port:
        url = f"simusb:{port.url.removeprefix('serial:')}" if usb else port.url
        result, figures, recording, bundle = run(flow_folder, settings, open_link(url), 0.3, url)
    assert result.ended == "completed"
    gates = figures["gates"]
    assert gates["asked"] == gates["done"] + gates["refused"] + gates["expired"]
    assert gates["done"] > 0
    again = replay(recording, bundle)
    assert (again.as_recorded, again.decisions) == (True, len(recording.decisions()))
