"""The firmware written from the documents alone under the package's host: over real ports, and in virtual time with trouble."""

from __future__ import annotations

import json
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_bench import D_F, EXPOSURE_US, FASHION, LEVELS, PEAK_HZ, SCENE, Bench, VirtualLab, profile_text
from lab_bundle import read_bundle
from lab_decisions import decide_again
from lab_firmware import SAFE, Firmware
from lab_light import Light
from lab_recording import read_recording
from live_status import ask_for_gate

from pans.app.main import main
from pans.instrument.profile import load_profile
from pans.live.loop import Observers, RunResult, Status
from pans.protocol.wire.commands import Gate
from pans_sim.conform import conform

HERE = Path(__file__).parent
ARM, STOP, RESET, GATE = 3, 4, 5, 6
TOO_LATE, OUT_OF_RANGE = 5, 3


def expected_accuracy(repeats: int) -> tuple[float, float]:
    """The accuracy that the table must have on the scene with these clicks, and its standard deviation over `repeats` passes."""
    bundle = read_bundle(FASHION.read_bytes())
    light = Light.of_scene(SCENE, PEAK_HZ, LEVELS, 0)
    light.show(bundle.parts["pattern_levels"], EXPOSURE_US * 1e-6)
    click = 1 - np.exp(-light.expected)
    words = np.arange(1 << D_F)[:, None] >> np.arange(D_F) & 1
    chance = np.ones((len(click), 1 << D_F))
    for i in range(D_F):
        chance *= np.where(words[:, i], click[:, i : i + 1], 1 - click[:, i : i + 1])
    labels = bundle.parts["table"].argmax(axis=1)
    right = (chance * (labels == light.labels[:, None])).sum(axis=1)
    return float(right.mean()), float(np.sqrt((right * (1 - right)).sum() / repeats) / len(right))


@contextmanager
def firmware_process(*options: str) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """The firmware in a process of its own that cannot see the package; yields its URL and, afterwards, its books."""
    words = [sys.executable, str(HERE / "lab_port.py"), "--scene", str(SCENE), "--levels", str(LEVELS)]
    books: list[dict[str, Any]] = []
    with subprocess.Popen([*words, "--peak-hz", str(PEAK_HZ), *options], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip(), books
            process.send_signal(signal.SIGTERM)
            books.append(json.loads(process.communicate(timeout=20)[0].splitlines()[-1]))
        finally:
            process.kill()


@pytest.mark.parametrize(("port", "mode"), [("tcp", "sequential"), ("pty", "sequential"), ("tcp", "parallel")])
def test_a_run_over_a_port_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str], port: str, mode: str) -> None:
    (tmp_path / "lab.toml").write_text(profile_text(mode))
    seed, passes = secrets.randbelow(1 << 32), 2
    options = ["--listen", port, "--mode", mode, "--seed", str(seed)]
    with firmware_process(*options, "--channels", str(D_F if mode == "parallel" else 1)) as (url, kept):
        words = ["--device", url, "--profile", str(tmp_path / "lab.toml"), "--decisions", str(200 * passes), "--trials"]
        code = main(["run", str(FASHION), *words, "1", "--no-realtime", "--json", "--out", str(tmp_path / "out")])
    print(f"seed {seed}", file=sys.stderr)
    summary, books = json.loads(capsys.readouterr().out), kept[0]
    assert (code, summary["verdict"], summary["faults"], summary["simulated"]) == (0, "PASS", [], True)
    mean, deviation = expected_accuracy(passes)
    assert summary["accuracy"] == pytest.approx(mean, abs=5 * deviation)
    assert summary["decisions"] == 200 * passes
    assert books["exposures"] == summary["stream"]["exposures"]
    assert books["messages"] == books["sent"] == summary["stream"]["messages"]
    assert (books["dropped"], books["refused"], books["foreign"], books["lease_expiries"]) == (0, [], 0, 0)
    assert {int(opcode) for opcode in books["commands"]} == {1, 2, ARM, STOP, RESET}
    assert books["sessions"] == 1
    assert books["pings"] >= 16
    assert books["grants"] >= 1
    recording = read_recording((tmp_path / "out" / "run.pansrec").read_bytes())
    assert decide_again(recording, read_bundle(recording.bundle)).tobytes() == recording.rows.tobytes()
    stream = [body for _, body in recording.messages if body[0] >= 0x90]
    assert len(stream) == books["messages"]


def at_decision(number: int, act: Any) -> Observers:
    """Do something once, when so many decisions have been made."""
    left = [act]

    def watch(run: Status, output: Any) -> None:
        if left and run.core.n_decisions >= number:
            left.pop()(run)

    return Observers(watch)


def reconcile(bench: Bench, result: RunResult, lossy: bool = False) -> None:
    """What the device has done is what the host has seen, exposure by exposure; messages lost behind the last one have no number."""
    stream, books = result.stream, bench.books
    assert stream["exposures"] + stream["lost_exposures"] == books.exposures + books.dropped
    assert stream["device_drops"] == books.dropped
    counted = stream["messages"] + stream["lost_messages"]
    assert counted == books.messages or (lossy and counted < books.messages)
    assert (books.foreign, bench.firmware.cutter.damaged, stream["malformed"], stream["repeated"]) == (0, 0, 0, 0)


def test_a_pause_within_the_lease_costs_what_the_device_says_it_dropped(tmp_path: Path) -> None:
    bench = Bench(tmp_path, deadline_us=900.0, buffer_messages=8)  # one exposure in each block: 4900 messages in 0.9 s
    result = bench.run(at_decision(200, lambda run: bench.link.pause(0.9)), decisions=1000)
    reconcile(bench, result)
    assert bench.books.lease_expiries == 0
    assert result.stream["lost_exposures"] == bench.books.dropped > 500
    assert bench.books.most_held == 8
    assert result.ended == "completed"
    assert 50 < result.tally.abstained < 500


def test_a_pause_beyond_the_lease_turns_the_light_off(tmp_path: Path) -> None:
    bench = Bench(tmp_path, deadline_us=1e5)  # a lease of 1 s
    seen: list[int] = []

    def stand_still(run: Status) -> None:
        bench.link.pause(5.0)
        bench.firmware.advance(bench.link.ticks())
        seen.append(bench.firmware.state)

    result = bench.run(at_decision(100, stand_still), decisions=1500)
    assert seen == [SAFE]
    assert (bench.books.lease_expiries, bench.books.sessions, result.reconnects) == (1, 2, 1)
    assert result.ended == "completed"
    assert result.tally.decisions - result.tally.abstained >= 1498


def test_a_run_without_end_is_stopped(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    result = bench.run(Observers(), seconds=0.5)
    reconcile(bench, result)
    assert (result.ended, bench.books.commands[STOP], bench.books.dropped) == ("time is up", 1, 0)
    assert 200 < result.tally.decisions < 230


def test_gates_are_done_or_refused_with_a_reason(tmp_path: Path) -> None:
    bench = Bench(tmp_path)

    def ask(run: Status) -> None:
        now = bench.link.ticks()
        for gate in (Gate(now + 20_000, 50, 0), Gate(now - 1, 60, 0), Gate(now + 30_000, 70, 9)):
            ask_for_gate(run, *gate)

    result = bench.run(at_decision(50, ask), decisions=100)
    assert [(length, output) for _, length, output in bench.books.pulses] == [(50, 0)]
    assert bench.books.refused == [(GATE, TOO_LATE), (GATE, OUT_OF_RANGE)]
    refusals = [event for event in result.events if event["kind"] == "gate_refused"]
    assert [event["status"] for event in refusals] == [TOO_LATE, OUT_OF_RANGE]


@pytest.mark.parametrize("mode", ["sequential", pytest.param("parallel", marks=pytest.mark.slow)])
def test_it_keeps_every_rule(mode: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(profile_text(mode))
    light, parallel = Light.of_scene(SCENE, PEAK_HZ, LEVELS, 1), mode == "parallel"
    firmware = Firmware(light, parallel=parallel, channels=D_F if parallel else 1)
    found = conform(VirtualLab(firmware), load_profile(str(tmp_path / "lab.toml")), pixels=light.images[0].size)
    assert {one.number: one.why for one in found if one.verdict in ("broken", "gone")} == {}
    assert sum(one.verdict == "kept" for one in found) >= 70


def test_what_is_lost_on_the_way_is_sent_again_or_reported(tmp_path: Path) -> None:
    bench = Bench(tmp_path, lose=0.05)
    result = bench.run(Observers(), decisions=400)
    assert result.ended == "completed"
    if not result.reconnects:
        reconcile(bench, result, lossy=True)
    assert result.stream["lost_exposures"] > 0
    assert bench.books.dropped == 0
