"""Runs of automata, driven by the device and by the host, in virtual time: the same walks, and no guess where something is missing."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from commands import json_of

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import write_bundle
from pans.runtime.cli import main
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.record import Recording, read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.parts import parts_in
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.wire.messages import DARK_PATTERN

N_OBJECTS = 40
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
    capsys: pytest.CaptureFixture[str], folder: Path, out: Path, *words: Any, more: str = "", trials: int = 2
) -> tuple[dict[str, Any], np.ndarray]:
    """The summary of a run, and its decisions."""
    device = f"sim:dmd-spad?scene={folder / 'tiny.npz'}&seed=5&pace=fast{more}"
    options = ("--decisions", N_OBJECTS * trials, "--trials", trials, "--out", out, *words)
    bundle = folder / "walk.pans"
    summary = json_of(capsys, "", "run", bundle, "--device", device, *options, code=None)
    return summary, np.zeros(0) if "--rotate-mb" in words else read_recording(out / "run.pansrec").decisions()


def replays(path: Path) -> bool:
    return main(["replay", str(path)]) == 0


def test_the_host_and_the_device_give_the_same_walks(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = {drive: run(capsys, folder, tmp_path / drive, "--drive", drive) for drive in ("device", "host")}
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


def walked_by_hand(automaton: Automaton, recording: Recording) -> list[tuple[int, int, int]]:
    """Photons, label and exposures of every walk, from the recorded bytes of COUNTS as protocol.md lays them out."""
    exposures: dict[int, tuple[int, int]] = {}
    for _, body in recording.messages():
        if body[0] == 0x93:
            first, _, n, largest, _ = struct.unpack_from("<QIHHI", body, 8 + 16)
            assert largest == automaton.n_outcomes - 1
            stamps, numbers = struct.unpack_from(f"<{n}H", body, 8 + 36), body[8 + 36 + 2 * n :]
            exposures |= {first + i: (stamps[i], numbers[i]) for i in range(n)}
    rows, slots = [], automaton.n_slots + 1  # one dark slot in a cycle
    for cycle in range(len(exposures) // slots):
        node, photons, taken = 0, 0, 0
        for stamp, number in (exposures[cycle * slots + slot] for slot in range(slots)):
            if node < automaton.n_states and stamp == node:
                node, photons, taken = int(automaton.successors[node][number]), photons + number, taken + 1
        rows.append((photons, int(automaton.posteriors[node].argmax()), taken))
    return rows


def test_photon_numbers_lead_the_same_walks_by_the_device_and_by_the_host(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    automaton = random_automaton(4, slots=5, width=6, patterns=4, outcomes=4)
    write_bundle(automaton_bundle(automaton, levels=2, photons_per_level=0.29), tmp_path / "counted.pans")
    found = {}
    for drive in ("device", "host"):
        device = f"sim:dmd-qcmos?scene={folder / 'tiny.npz'}&seed=5&pace=fast"
        words = ("--decisions", 2 * N_OBJECTS, "--trials", 2, "--drive", drive, "--out", tmp_path / drive)
        summary = json_of(capsys, "", "run", tmp_path / "counted.pans", "--device", device, *words, code=None)
        assert (summary["verdict"], summary["late_slots"], summary["wrong_patterns"]) == ("PASS", 0, 0)
        assert "compiled" in summary["realtime"]["turn"]
        path = tmp_path / drive / "run.pansrec"
        recording = read_recording(path)
        assert recording.header["config"]["photon_number_max"] == 3
        assert replays(path)
        assert main(["verify", str(path)]) == 0
        found[drive] = recording.decisions()
        assert found[drive][["clicks", "label", "exposures"]].tolist() == walked_by_hand(automaton, recording)
        plan = recorded_plan(recording)
        clicks = click_list(recording, plan)
        lit = clicks.pattern != DARK_PATTERN
        assert clicks.photons[lit].sum() == found[drive]["clicks"].sum()
        assert set(clicks.photons.tolist()) == {1, 2, 3}
    assert found["device"][list(WALKS)].tolist() == found["host"][list(WALKS)].tolist()
    assert main(["report", str(tmp_path / "device" / "run.pansrec"), "--out", str(tmp_path / "page.html")]) == 0
    assert "photon number from 0 to 3" in (tmp_path / "page.html").read_text()


def test_a_walk_stops_when_it_is_sure_and_abstains_where_it_is_not(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, whole = run(capsys, folder, tmp_path / "whole")
    runs = [run(capsys, folder, tmp_path / d, "--drive", d, "--confidence", 0.8) for d in ("device", "host")]
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
    assert replays(tmp_path / "device" / "run.pansrec")


def test_a_host_that_is_held_up_leaves_slots_dark_and_guesses_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, fine = run(capsys, folder, tmp_path / "fine", "--drive", "host")
    summary, walks = run(capsys, folder, tmp_path / "late", "--drive", "host", more="&faults=stall:3ms/37ms")
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
def test_what_the_link_loses_is_never_guessed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: str
) -> None:
    _, fine = run(capsys, folder, tmp_path / "fine", "--drive", drive)
    words = ("--drive", drive)
    summary, walks = run(capsys, folder, tmp_path / "lossy", *words, more="&faults=loss:0.02,duplicate:0.02,flip:0.01")
    assert len(walks) == len(fine)
    decided = walks["label"] != NO_LABEL
    assert 0 < decided.sum() < len(walks)
    same = ("clicks", "label", "probability", "counts_crc", "exposures", "shot")
    assert walks[decided][list(same)].tolist() == fine[decided][list(same)].tolist()
    assert summary["lost"] > 0
    assert replays(tmp_path / "lossy" / "run.pansrec")


@pytest.mark.parametrize("drive", ["device", "host"])
def test_a_lost_device_is_found_again_and_parts_replay_by_themselves(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], drive: str
) -> None:
    words = ("--drive", drive, "--rotate-mb", 0.003)
    summary, _ = run(capsys, folder, tmp_path, *words, more="&faults=disconnect:100ms/150ms", trials=4)
    assert summary["reconnects"] > 0
    assert summary["decisions"] == summary["abstained"] + sum(
        int((read_recording(part).decisions()["label"] != NO_LABEL).sum()) for part in parts_in(tmp_path)
    )
    assert len(parts_in(tmp_path)) > 2
    assert replays(tmp_path)


def test_what_makes_no_sense_with_walks_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle, device = str(folder / "walk.pans"), f"sim:dmd-spad?scene={folder / 'tiny.npz'}&pace=fast"
    refused = {
        ("--shots", "2"): "--shots 1",
        ("--on-dark", "tables"): "automaton",
        ("--on-dark", "mask"): "automaton",
        ("--backend", "onnx"): "automaton",
        ("--order", "pattern-major"): "automaton",
    }
    for words, said in refused.items():
        assert main(["run", bundle, "--device", device, "--decisions", "3", "--out", str(tmp_path / "no"), *words]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
