"""Runs of automata in virtual time, by the device and by the host, of one detector and of several: the same walks, and no guesses."""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from commands import Pans

from pans.app.main import main
from pans.base.errors import DeviceError, PlanError
from pans.bundle.backends import NO_LABEL
from pans.bundle.backends.expectation import expected_walk
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import write_bundle
from pans.decide.decision import DecisionFlag
from pans.decide.plan.plan import build_plan
from pans.instrument.click_law import click_law, object_transmission
from pans.instrument.profile import load_profile
from pans.live.device_check import check_automaton
from pans.protocol.wire import DARK_PATTERN
from pans.protocol.wire.commands import count_announcement
from pans.protocol.wire.schema import AUTOMATON_SCHEMA
from pans.record.reading import read_recording
from pans.record.reading.exposures import click_list
from pans.record.reading.parts import parts_in
from pans.record.reading.sent_plan import recorded_plan
from pans.record.tables.tables import click_table
from pans.report.compare import compare, read_side
from pans.report.pages.run import Decisions
from pans_sim.ports.serve import SimOptions, build_instrument

N_OBJECTS = 24
WALKS = ("object", "shot", "clicks", "label", "truth", "flags", "probability", "counts_crc", "exposures")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of seven slots and a scene of as many objects as a run sees."""
    folder = tmp_path_factory.mktemp("walks")
    automaton = random_automaton(4, slots=7, width=6)
    write_bundle(automaton_bundle(automaton, levels=2, photons_per_level=0.7), folder / "walk.pans")
    images = np.random.default_rng(2).integers(0, 256, (N_OBJECTS, 2, 2)).astype(np.uint8)
    labels = np.arange(N_OBJECTS, dtype=np.int16) % 3
    np.savez(folder / "tiny.npz", images=images, labels=labels, classes=np.array(["c0", "c1", "c2"]))
    return folder


def run(
    pans: Pans, folder: Path, out: Path, *words: Any, more: str = "", trials: int = 2
) -> tuple[dict[str, Any], np.ndarray]:
    """The summary of a run, and its decisions."""
    device = f"sim:dmd-spad?scene={folder / 'tiny.npz'}&seed=5&pace=fast{more}"
    options = ("--decisions", N_OBJECTS * trials, "--trials", trials, "--out", out, *words)
    bundle = folder / "walk.pans"
    summary = pans("run", bundle, "--device", device, *options, code=None)
    return summary, np.zeros(0) if "--rotate-mb" in words else read_recording(out / "run.pansrec").decisions()


def replays(path: Path) -> bool:
    return main(["replay", str(path)]) == 0


def test_the_host_and_the_device_give_the_same_walks(folder: Path, tmp_path: Path, pans: Pans) -> None:
    runs = {drive: run(pans, folder, tmp_path / drive, "--drive", drive) for drive in ("device", "host")}
    (by_device, walks), (by_host, named) = runs["device"], runs["host"]
    assert walks[list(WALKS)].tolist() == named[list(WALKS)].tolist()
    assert len(set(walks["exposures"].tolist())) > 2
    assert walks["clicks"].any()
    for summary, decisions in runs.values():
        assert (summary["verdict"], summary["late_slots"], summary["wrong_patterns"]) == ("PASS", 0, 0)
        assert summary["exposures_mean"] == decisions["exposures"].mean()
        assert summary["illumination"] == summary["illumination_mean"] > 0
        assert summary["dark"]["exposures"] == 2 * N_OBJECTS * 8 - decisions["exposures"].sum()
    assert (by_device["drive"], by_device["turn_us"], by_device["turn_budget_us"]) == ("device", None, None)
    assert (by_host["drive"], by_host["turn_budget_us"]) == ("host", 1000.0)
    assert by_host["illumination_mean"] == by_device["illumination_mean"]
    for drive in runs:
        assert replays(tmp_path / drive / "run.pansrec")
        assert main(["verify", str(tmp_path / drive / "run.pansrec")]) == 0


def test_photon_numbers_lead_the_same_walks_by_the_device_and_by_the_host(
    folder: Path, tmp_path: Path, pans: Pans
) -> None:
    automaton = random_automaton(4, slots=5, width=6, patterns=4, outcomes=4)
    write_bundle(automaton_bundle(automaton, levels=2, photons_per_level=0.29), tmp_path / "counted.pans")
    found = {}
    for drive in ("device", "host"):
        device = f"sim:dmd-qcmos?scene={folder / 'tiny.npz'}&seed=5&pace=fast"
        words = ("--decisions", 2 * N_OBJECTS, "--trials", 2, "--drive", drive, "--out", tmp_path / drive)
        summary = pans("run", tmp_path / "counted.pans", "--device", device, *words, code=None)
        assert (summary["verdict"], summary["late_slots"], summary["wrong_patterns"]) == ("PASS", 0, 0)
        assert "compiled" in summary["realtime"]["turn"]
        path = tmp_path / drive / "run.pansrec"
        recording = read_recording(path)
        assert recording.header["config"]["photon_number_max"] == 3
        assert replays(path)
        assert main(["verify", str(path)]) == 0
        found[drive] = recording.decisions()
        plan = recorded_plan(recording)
        clicks = click_list(recording, plan)
        lit = clicks.pattern != DARK_PATTERN
        assert clicks.photons[lit].sum() == found[drive]["clicks"].sum()
        assert set(clicks.photons.tolist()) == {1, 2, 3}
    assert found["device"][list(WALKS)].tolist() == found["host"][list(WALKS)].tolist()
    assert main(["report", str(tmp_path / "device" / "run.pansrec"), "--out", str(tmp_path / "page.html")]) == 0
    assert "photon number from 0 to 3" in (tmp_path / "page.html").read_text()


def test_a_walk_stops_when_it_is_sure_and_abstains_where_it_is_not(folder: Path, tmp_path: Path, pans: Pans) -> None:
    _, whole = run(pans, folder, tmp_path / "whole")
    runs = [run(pans, folder, tmp_path / d, "--drive", d, "--confidence", 0.8) for d in ("device", "host")]
    (summary, walks), (_, named) = runs
    assert walks[list(WALKS)].tolist() == named[list(WALKS)].tolist()
    assert walks["exposures"].mean() < whole["exposures"].mean()
    unsure = walks["probability"] < np.float32(0.8)
    assert 0 < unsure.sum() < len(walks)
    assert (walks["label"][unsure] == NO_LABEL).all()
    assert (walks["flags"][unsure] == DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED).all()
    assert not walks["flags"][~unsure].any()
    assert (summary["verdict"], summary["confidence"]) == ("PASS", 0.8)
    assert summary["abstained_below_confidence"] == summary["abstained"] == unsure.sum()
    path = tmp_path / "device" / "run.pansrec"
    assert replays(path)
    facts, page = pans("info", path), Decisions({"tick_hz": 1e6}, len(walks))
    page.take(walks)
    labelled = walks[~unsure]
    assert summary["accuracy"] == facts["accuracy"] == page.right / page.judged
    assert summary["accuracy"] == (labelled["label"] == labelled["truth"]).mean()
    assert summary["clicks_mean"] == facts["clicks_mean"] == labelled["clicks"].mean() != walks["clicks"].mean()
    assert summary["judged"] == facts["judged"] == len(labelled) == len(walks) - facts["abstained"]
    assert summary["figures_of"]["illumination"] == "decisions"  # of the states that were shown
    one = read_side(path)
    assert {f.name: f.first for f in compare(one, one).findings}["accuracy"] == summary["accuracy"]


def test_a_host_that_is_held_up_leaves_slots_dark_and_guesses_nothing(folder: Path, tmp_path: Path, pans: Pans) -> None:
    _, fine = run(pans, folder, tmp_path / "fine", "--drive", "host")
    summary, walks = run(pans, folder, tmp_path / "late", "--drive", "host", more="&faults=stall:3ms/37ms")
    late = walks["flags"] == DecisionFlag.WRONG_PATTERN | DecisionFlag.ABSTAINED
    assert 0 < late.sum() < len(walks)
    assert not walks["flags"][~late].any()
    assert summary["late_slots"] == summary["wrong_patterns"] == late.sum()
    assert walks[~late][list(WALKS)].tolist() == fine[~late][list(WALKS)].tolist()
    assert any("named their state too late" in fault for fault in summary["faults"])
    recording = read_recording(tmp_path / "late" / "run.pansrec")
    refused = [event for event in recording.events() if event["kind"] == "show_refused"]
    assert refused
    assert {event["status"] for event in refused} == {5}  # too late
    assert replays(recording.path)


@pytest.mark.parametrize("drive", ["device", "host"])
def test_a_lost_device_is_found_again_and_parts_replay_by_themselves(
    folder: Path, tmp_path: Path, pans: Pans, drive: str
) -> None:
    words = ("--drive", drive, "--rotate-mb", 0.003)
    summary, _ = run(pans, folder, tmp_path, *words, more="&faults=disconnect:100ms/150ms", trials=4)
    assert summary["reconnects"] > 0
    assert summary["decisions"] == summary["abstained"] + sum(
        int((read_recording(part).decisions()["label"] != NO_LABEL).sum()) for part in parts_in(tmp_path)
    )
    assert len(parts_in(tmp_path)) > 2
    assert replays(tmp_path)


def test_what_makes_no_sense_with_walks_is_refused(folder: Path, tmp_path: Path, pans: Pans) -> None:
    bundle, device = str(folder / "walk.pans"), f"sim:dmd-spad?scene={folder / 'tiny.npz'}&pace=fast"
    refused = {
        ("--shots", "2"): "--shots 1",
        ("--on-dark", "tables"): "automaton",
        ("--on-dark", "mask"): "automaton",
        ("--backend", "onnx"): "automaton",
        ("--order", "pattern-major"): "automaton",
    }
    for words, said in refused.items():
        assert said in pans.refuses(
            "run", bundle, "--device", device, "--decisions", "3", "--out", tmp_path / "no", *words
        )
    assert not (tmp_path / "no").exists()


TRIALS, CHANNELS = 3, 3
PROFILE = load_profile("dmd-four-snspd")
IMAGES = np.random.default_rng(2).integers(0, 256, (N_OBJECTS, 2, 2)).astype(np.uint8)


def bundle() -> Bundle:
    automaton = random_automaton(4, slots=5, width=6, patterns=6, channels=CHANNELS)
    return automaton_bundle(automaton, levels=2, photons_per_level=0.5)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle, a scene, and a run by either drive."""
    folder = tmp_path_factory.mktemp("at-once")
    write_bundle(bundle(), folder / "walk.pans")
    labels = np.arange(N_OBJECTS, dtype=np.int16) % 3
    np.savez(folder / "tiny.npz", images=IMAGES, labels=labels, classes=np.array(["c0", "c1", "c2"]))
    for drive in ("device", "host"):
        device = f"sim:dmd-four-snspd?scene={folder / 'tiny.npz'}&seed=5&pace=fast"
        words = ["--decisions", str(TRIALS * N_OBJECTS), "--trials", str(TRIALS), "--drive", drive, "-q"]
        assert main(["run", str(folder / "walk.pans"), "--device", device, *words, "--out", str(folder / drive)]) == 0
    return folder


def test_device_and_host_lead_the_same_walks(runs: Path) -> None:
    recordings = [read_recording(runs / drive / "run.pansrec") for drive in ("device", "host")]
    by_device, by_host = (recording.decisions() for recording in recordings)
    for recording in recordings:
        assert recording.header["config"]["channels_at_once"] == CHANNELS
        assert replays(recording.path)
        assert main(["verify", str(recording.path)]) == 0
    assert by_device[list(WALKS)].tolist() == by_host[list(WALKS)].tolist()
    assert len(set(by_device["exposures"].tolist())) > 2


def test_a_run_is_within_its_exact_expectation(runs: Path) -> None:
    made = bundle()
    plan = build_plan(PROFILE, made)
    seen = object_transmission(PROFILE, IMAGES.reshape(N_OBJECTS, -1))
    law = click_law(PROFILE, plan.exposure_us)
    found = expected_walk(made.automaton, made.pattern_levels, seen, law, made.photons_per_level)
    rows = read_recording(runs / "device" / "run.pansrec").decisions()
    for name, wanted in (("clicks", found.clicks), ("exposures", found.exposures)):
        of_objects = rows[name].reshape(N_OBJECTS, TRIALS)
        error = math.sqrt(of_objects.var(axis=1, ddof=1).sum() / TRIALS) / N_OBJECTS
        assert abs(of_objects.mean() - wanted.mean()) < 3.5 * error
    decided = np.bincount(rows["label"], minlength=3) / len(rows)
    of_class = made.automaton.posteriors[made.automaton.n_states :].argmax(axis=1)
    chance = np.array([found.leaves[:, of_class == label].sum() / N_OBJECTS for label in range(3)])
    assert np.abs(decided - chance).max() < 3.5 * 0.5 / math.sqrt(len(rows))


def test_clicks_are_exported_by_channel_and_reported(runs: Path, tmp_path: Path, pans: Pans) -> None:
    path, automaton = runs / "host" / "run.pansrec", bundle().automaton
    recording = read_recording(path)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    lit = clicks.pattern != DARK_PATTERN
    assert lit.sum() == recording.decisions()["clicks"].sum()
    assert set(clicks.channel.tolist()) == set(range(CHANNELS))
    assert (clicks.pattern[lit] == automaton.pattern[clicks.state[lit]] + clicks.channel[lit]).all()
    assert main(["export", "--format", "csv", "--out", str(tmp_path), str(path)]) == 0
    with (tmp_path / "clicks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["channel"]) for row in rows] == clicks.channel.tolist()
    assert {row["photons"] for row in rows} == {""}  # clicks, not photon numbers
    of = np.array([int(row["decision"]) for row in rows if row["dark_slot"] == "0"])
    assert np.bincount(of, minlength=recording.n_decisions).tolist() == recording.decisions()["clicks"].tolist()
    dark = clicks._replace(pattern=np.full_like(clicks.pattern, DARK_PATTERN))
    assert np.ma.getmaskarray(click_table(recording, plan, dark)["decision"]).all()
    assert main(["report", str(path), "--out", str(tmp_path / "page.html")]) == 0
    assert "patterns, side by side" in (tmp_path / "page.html").read_text()
    facts = pans("info", runs / "walk.pans")
    assert (facts["automaton"]["channels"], facts["automaton"]["outcomes"]) == (CHANNELS, 1 << CHANNELS)


def test_an_instrument_of_fewer_detectors_is_refused_with_the_numbers() -> None:
    made = bundle()
    with pytest.raises(PlanError, match="reads 3 detectors at once, dmd-spad measures in sequential mode and has 1"):
        build_plan(load_profile("dmd-spad"), made)
    plan = build_plan(PROFILE, made)
    facts = {"automaton_schema": AUTOMATON_SCHEMA, "automaton_states": 100, "dwell_steps": 8}
    check_automaton(facts | count_announcement(1, 3), plan)
    for told in ({}, count_announcement(15), count_announcement(1, 2), {"channels_at_once": 4, "count_schema": 1}):
        with pytest.raises(DeviceError, match=r"reads [12] detector\(s\) at once, needed 3"):
            check_automaton(facts | told, plan)
    device, _ = build_instrument(SimOptions("dmd-four-snspd", "uniform"), 0)
    assert (device.number_max, device.channels_max) == (1, 4)


def test_a_dead_detector_never_clicks(runs: Path, tmp_path: Path) -> None:
    """Walks that are followed exposure by exposure: the scene changes with time."""
    scene = tmp_path / "dead.toml"
    source = f'kind = "still"\nimages = "{runs / "tiny.npz"}"\n'
    scene.write_text(source + '[[change]]\nkind = "dead"\nat_s = 0\nchannel = 1\n')
    device = f"sim:dmd-four-snspd?scene={scene}&seed=5&pace=fast"
    words = ["--decisions", str(2 * N_OBJECTS), "--trials", "2", "-q", "--out", str(tmp_path / "out")]
    assert main(["run", str(runs / "walk.pans"), "--device", device, *words]) in (0, 1)
    recording = read_recording(tmp_path / "out" / "run.pansrec")
    channels = click_list(recording, recorded_plan(recording)).channel.tolist()
    assert channels.count(1) == 0
    assert min(channels.count(0), channels.count(2)) > 20


@pytest.mark.parametrize(
    ("change", "policy", "kind", "level"),
    [("dead:at_s=0.1", "abstain", "dead", "warning"), ("hot:at_s=0.1:rate_hz=20000", "warn", "hot", "alarm")],
)
def test_what_one_of_several_detectors_does_in_the_dark_is_told_of_it_alone(
    runs: Path, tmp_path: Path, change: str, policy: str, kind: str, level: str, pans: Pans
) -> None:
    device = f"sim:dmd-four-snspd?scene={runs / 'tiny.npz'}&seed=5&pace=fast&changes={change}:channel=1"
    words = ("--dark-slots", 2, "--decisions", 400, "--trials", 20, "--on-dark", policy, "--out", tmp_path)
    summary = pans("run", runs / "walk.pans", "--device", device, *words, code=None)
    dark = summary["dark"]
    found = [finding for finding in dark["findings"] if finding["state"] == kind]
    assert [(finding["channels"], finding["level"]) for finding in found] == [([1], level)]
    for channel, row in enumerate(dark["channels"]):
        assert (row["low"] <= row["expected"] * 1.15 and row["high"] >= row["expected"] * 0.85) == (channel != 1)
    assert dark["expected"] == pytest.approx(1 - (1 - dark["channels"][0]["expected"]) ** CHANNELS)
    without = np.flatnonzero(read_recording(tmp_path / "run.pansrec").decisions()["flags"] & DecisionFlag.DARK_ALARM)
    assert len(without) == summary["abstained"]
    assert (len(without) > 100) == (policy == "abstain")
    assert (np.diff(without) == 1).all()
    assert main(["replay", str(tmp_path / "run.pansrec")]) == 0
