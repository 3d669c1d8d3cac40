"""Runs with objects in flow, in virtual time and over a descriptor: figures, pulses, recording, replay; refusals."""

import json
import math
import random
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import Pans
from links import served

from pans.base.errors import ConfigError, PlanError
from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.decide.flow.core import FlowCore
from pans.decide.flow.make import build_flow_plan, plan_flow
from pans.decide.flow.settings import FlowSettings, flow_of_header, read_flow
from pans.instrument.profile import load_profile
from pans.live import session
from pans.live.dark_run import DarkRun
from pans.live.flow_run import FlowRun
from pans.live.loop import Job, Observers, Recovery, Status, run_live
from pans.live.options import RunOptions
from pans.protocol.links.base import open_link
from pans.protocol.wire import DARK_PATTERN
from pans.record.reading import read_recording
from pans.record.reading.exposures import click_list
from pans.record.reading.sent_plan import recorded_plan
from pans.record.recorder import Recorder
from pans.record.replay import replay
from pans.record.tables.tables import click_table
from pans_sim.ports.serve import build_instrument, open_sim, parse_sim_url
from pans_trainer.export.tape_bundle import Tape, exact_table, tape_bundle

PROFILE = load_profile("flow-snspd")


def run_command(folder: Path, pans: Pans, *more: str | Path, faults: str = "", code: int = 0) -> dict[str, Any]:
    device = f"sim:flow-snspd?scene={folder / 'cells.toml'}&seed=4&pace=fast&faults={faults}"
    words = (folder / "thirds.pans", "--device", device, "--flow", folder / "flow.toml", "--out", folder / "out")
    return pans("run --force --seconds 0.1", *words, *more, code=code)


def test_cells_are_decided_once_gated_on_time_and_replayed(flow_folder: Path, pans: Pans) -> None:
    summary = run_command(flow_folder, pans, "--gate-class", "b,c")
    counts, gates = summary["passages"], summary["gates"]
    assert counts["marks"] > 150
    assert counts["alone"] > 80
    assert summary["missed"] <= 0.05
    assert summary["doubled"] == 0.0
    assert summary["accuracy_labelled"] > 0.97
    assert gates["asked"] == gates["done"] > 50
    assert summary["yield"] > 0.5
    assert summary["passage_clicks_mean"] > 5 * summary["clicks_mean"]
    assert summary["flow"]["gate_classes"] == ["b", "c"]
    page = Path(summary["report"]).read_text()
    assert "SIMULATED" in page
    assert f"; yield {summary['yield']:.3%} (" in page
    recording = read_recording(Path(summary["recording"]))
    assert recording.n_decisions == counts["decisions"]
    plan = recorded_plan(recording)
    clicks = click_table(recording, plan, click_list(recording, plan))
    assert len(clicks["channel"]) > 1000
    assert np.ma.getmaskarray(clicks["decision"]).all()
    replayed = pans("replay", summary["recording"])
    assert replayed["identical"] is True
    for key in ("accuracy", "passages", "aborted", "yield", "purity", "missed", "clicks_mean"):
        assert replayed[key] == summary[key]


def test_the_instrument_pulses_what_was_asked_for_and_nothing_else(flow_folder: Path) -> None:
    asked: list[int] = []
    link = open_sim(f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=4&pace=fast")
    device = link.device  # type: ignore[attr-defined]

    def watch(run: Status, output: Any) -> None:
        asked.extend(action.tick for action in output.actions)

    result, figures, _, _ = run(flow_folder, replace(SETTINGS, gate_classes=("a",)), link, 0.05, watch=watch)
    pulses = [pulse.tick for pulse in device.gates.pulses]
    assert (result.ended, pulses) == ("completed", asked[: len(pulses)])
    assert len(asked) > 20
    assert figures["gates"]["done"] == figures["passages"]["pulses"] == len(pulses)


def test_a_late_decision_does_not_pulse_although_its_pulse_could_still_be_made(flow_folder: Path) -> None:
    """A deadline below the gate's delay of 900 us: blocks end up to 500 us behind the objects in them."""
    link = open_sim(f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=4&pace=fast")
    device = link.device  # type: ignore[attr-defined]
    result, figures, recording, _ = run(flow_folder, SETTINGS, link, 0.05, deadline_us=150.0)
    events = list(recording.events())
    late = {event["decision"] for event in events if event["kind"] == "late"}
    expired = {event["decision"]: event["text"] for event in events if event["kind"] == "gate_expired"}
    gated = {int(row["index"]) for row in recording.decisions() if row["label"] in (0, 1)}
    assert set(expired) == late & gated
    assert all("later than the deadline allows" in text for text in expired.values())
    assert len(expired) > 5
    assert figures["gates"]["expired"] == len(expired)
    assert figures["gates"]["done"] == len(device.gates.pulses) == len(gated - late) > 5
    assert figures["passages"]["pulses"] == len(gated - late)
    assert result.ended == "completed"


def test_blocks_are_as_long_as_the_deadline_of_the_run_allows(flow_folder: Path, pans: Pans) -> None:
    """`--deadline-us` stands in the place of the profile's 1000 us, also where blocks are laid out."""
    found = run_command(flow_folder, pans, "--deadline-us", "10", code=2)
    assert "block_us is" in found["error"]["message"]
    folder = flow_folder / "deadlines"
    bundle, device = flow_folder / "thirds.pans", "sim:wdm-snspd?scene=uniform&seed=4&pace=fast"
    blocks = {}
    for deadline in (0, 100, 4000):
        words = ("--out", folder / str(deadline), "--deadline-us", deadline)
        done = pans("run --trials 2000 --decisions 4000", bundle, "--device", device, *words, code=None)
        recording = read_recording(Path(done["recording"]))
        plan = recorded_plan(recording)
        limit_us = done["deadline_us"] / 4
        block_us = plan.block_exposures * plan.slot_period_ticks * plan.tick_us
        assert block_us <= max(limit_us, plan.slot_period_ticks * plan.tick_us)
        assert recording.header["config"]["deadline_us"] == done["deadline_us"] == (deadline or 1000)
        assert pans("replay", done["recording"])["identical"]
        blocks[deadline] = plan.block_exposures
    assert blocks[100] < blocks[0] < blocks[4000]


def test_lost_blocks_are_never_decided_over(flow_folder: Path, pans: Pans) -> None:
    summary = run_command(flow_folder, pans, faults="loss:0.02", code=4)
    assert summary["lost"] > 0
    assert summary["aborted"]["gap"] > 0
    assert summary["accuracy_labelled"] > 0.97
    assert summary["passages"]["in_gaps"] > 0
    pans("replay", summary["recording"])


def run_tape(
    folder: Path, pans: Pans, *, dark: float, bars_per_s: float, more: str = "", seconds: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a tape without crosstalk, 50 000 bars per second being said; return the summary and the enumerated figures."""
    text = PROFILE.text.replace("crosstalk_probability = 0.001", "crosstalk_probability = 0.0")
    if dark >= 0:
        text = text.replace("dark_rate_hz = 130.0", f"dark_rate_hz = {dark / 5e-6:.6f}")
    (folder / "tape-profile.toml").write_text(text)
    (folder / "tape.toml").write_text(
        f'kind = "tape"\nbars = 10\npixels_per_bar = 8\nspeed_bars_per_s = {bars_per_s}\njitter_bars = 0.02\njitter_time_s = 0.01\n'
    )
    (folder / "flow.toml").write_text(f'kind = "tape"\nbars_per_s = 50000.0\nblock_us = 500.0\n{more}')
    profile = load_profile(str(folder / "tape-profile.toml"))
    bundle, figures = tape_bundle(profile, Tape(dark=max(dark, 0.0)))
    write_bundle(bundle, folder / "tape.pans")
    device = f"sim:{folder / 'tape-profile.toml'}?scene={folder / 'tape.toml'}&seed=9&pace=fast"
    words = (folder / "tape.pans", "--device", device, "--flow", folder / "flow.toml", "--out", folder)
    return pans(f"run --seconds {seconds}", *words), figures


def test_a_tape_is_read_as_well_as_the_exact_optimum(tmp_path: Path, pans: Pans) -> None:
    """No crosstalk and a stated dark rate: then nothing but chance may lie between 6000 bars and the enumerated accuracy."""
    summary, figures = run_tape(tmp_path, pans, dark=0.01, bars_per_s=50_000.0, seconds="0.12")
    n, exact = summary["passages"]["alone"], figures["exact_accuracy"]
    assert n >= 5_990
    assert (summary["missed"], summary["doubled"]) == (0.0, 0.0)
    assert abs(summary["accuracy"] - exact) < 5 * math.sqrt(exact * (1 - exact) / n) + 0.0005
    # neighbouring windows share bars
    assert abs(summary["clicks_mean"] - figures["clicks_mean"]) < 5 * math.sqrt(2.5 / n) * 3 + 0.02
    assert summary["clicks_mean"] < 5.3


def test_a_tape_that_is_faster_than_said_is_followed(tmp_path: Path, pans: Pans) -> None:
    summary, _ = run_tape(tmp_path, pans, dark=-1, bars_per_s=50_500.0, more="track = 3\n", seconds="0.03")
    assert summary["passages"]["alone"] > 1400
    assert summary["accuracy"] > 0.995  # not followed it is lost within 50 bars
    assert summary["flow"]["bars_per_s"] == pytest.approx(50_500.0, rel=0.005)
    assert pans("replay", tmp_path / "run.pansrec")["identical"]


def test_the_exact_table_without_dark_counts_and_with_endless_light_is_the_truth() -> None:
    table, accuracy, clicks = exact_table(60.0, 0.0)
    assert accuracy == pytest.approx(1.0, abs=1e-12)
    assert clicks == pytest.approx(5.0)
    word = sum(1 << bar for bar in (3, 5))  # 0001010000
    assert table[word].argmax() == 1


def thirds(flow_folder: Path) -> Bundle:
    return load_bundle(flow_folder / "thirds.pans")[0]


def test_a_flow_plan_has_dark_frames_where_asked_for(flow_folder: Path) -> None:
    plan = build_flow_plan(PROFILE, thirds(flow_folder), block_us=250.0, dark_every=3)
    assert (plan.block_exposures, plan.slots_per_cycle, plan.shots_per_object) == (125, 375, 374)
    assert np.flatnonzero(plan.slot_pattern == DARK_PATTERN).tolist() == [374]
    assert plan.cycle_us == pytest.approx(750.0)
    assert build_flow_plan(PROFILE, thirds(flow_folder), block_us=250.0).dark_slots_per_cycle == 0


@pytest.mark.parametrize(
    ("profile", "changes", "words"),
    [
        ("flow-snspd", {"block_us": 1.0}, "allowed"),
        ("flow-snspd", {"block_us": 2000.0}, "allowed"),
        ("flow-snspd", {"block_us": 250.0, "dark_every": 1000}, "allowed"),
        ("oled-qcmos", {"block_us": 250.0}, "all patterns at once"),
    ],
)
def test_a_flow_plan_that_cannot_be_is_refused(
    flow_folder: Path, profile: str, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(PlanError, match=words):
        build_flow_plan(load_profile(profile), thirds(flow_folder), **changes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "cells"\nspeed = 3\n', r"bad\.toml:2:1: unknown key speed"),
        ('kind = "cells"\nblock_us = -1.0\n', r"bad\.toml:2:1: block_us is -1\.0"),
        ('kind = "cells"\npool = 1.5\n', r"bad\.toml:2:1: pool is 1\.5"),
        ('kind = "cells"\ngate_classes = "a"\n', r"bad\.toml:2:1: gate_classes must be a list"),
        ("block_us = 250.0\n", r"bad\.toml:1:1: the key kind is missing"),
        ('kind = "waves"\n', r"bad\.toml:1:1: flow kind is 'waves'"),
    ],
)
def test_mistakes_in_settings_are_named_with_their_place(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_flow(str(tmp_path / "bad.toml"))


@pytest.mark.parametrize("name", ["cells", "tape"])
def test_shipped_settings_load_and_survive_a_header(name: str) -> None:
    settings = read_flow(name)
    assert settings.kind == name
    assert flow_of_header(json.loads(json.dumps(settings.as_header()))) == settings


def test_decisions_cannot_be_counted_beforehand(flow_folder: Path, pans: Pans) -> None:
    found = run_command(flow_folder, pans, "--decisions", "5", code=2)
    assert "as many decisions as objects pass" in found["error"]["message"]


SETTINGS = FlowSettings("cells", fields_per_s=20_000.0, onset_frames=4, gate_classes=("a", "b"))


def run(
    folder: Path,
    settings: FlowSettings,
    link: Any,
    seconds: float,
    url: str = "",
    watch: Any = None,
    deadline_us: float = 1e9,
) -> tuple[Any, ...]:
    bundle = load_bundle(folder / "thirds.pans")[0]
    plan, core, cycles = plan_flow(PROFILE, bundle, make_decider(bundle), settings, 1, seconds)
    dark = DarkRun.of(RunOptions(), PROFILE)
    core.guard = dark.guard(plan, bundle, 1, flow=True)
    flow, path = FlowRun(core, None), folder / "run.pansrec"
    config = RunOptions(n_cycles=cycles, deadline_us=deadline_us, realtime=False)
    facts = {"shots": 1, "tick_hz": PROFILE.clock.tick_hz, "backend": "table", "confidence": 0.0, "dark": dark.header()}
    with Recorder(path, {"config": facts | {"flow": flow.header()}}, overwrite=True) as recorder:
        recovery, observers = Recovery.of(link, url, 10.0), Observers(watch, flow.prepared)
        result = run_live(link, Job(PROFILE, bundle, plan, config), core, recorder, recovery, observers)
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
        monkeypatch.setattr(session, "secrets", SimpleNamespace(randbelow=numbers.randrange))
        if alone:
            monkeypatch.setattr(FlowCore, "takes", False)
        else:
            monkeypatch.undo()
            monkeypatch.setattr(session, "secrets", SimpleNamespace(randbelow=random.Random(7).randrange))
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
