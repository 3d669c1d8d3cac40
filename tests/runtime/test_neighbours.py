"""Decisions that leave a run for other programs, compared with what the run recorded: OSC read by python-osc, documents of bluesky."""

from __future__ import annotations

import asyncio
import math
import socket
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from lab_frames import MARK, open_body
from lab_recording import Recording, read_recording

from pans.app.main import main
from pans.base.errors import LinkError, PansError, UsageError
from pans.decide.decision import Decision, Output
from pans.live.watch.osc import PER_DATAGRAM, OscSender

PARALLEL = "sim:oled-qcmos?scene=fashion200&seed=1&pace="
STALLS = "faults=stall:20ms/200ms"  # work that is late
WALKS = "sim:dmd-spad?scene=fashion200&seed=1&pace="
NO_RUN: Any = type("Run", (), {"accounts": SimpleNamespace(late=())})()


def recorded(path: Path) -> tuple[list[tuple[Any, ...]], Recording]:
    """What a neighbour should have seen of each decision, from the recording alone."""
    recording = read_recording(path.read_bytes())
    late = {event["decision"] for event in recording.events if event["kind"] == "late"}
    rows = [
        (*row[:2], -1 if row[6] == 0xFFFF else row[6], row[9], row[5], row[8], row[0] in late)
        for row in recording.rows.tolist()
    ]
    return rows, recording


@pytest.mark.parametrize(
    ("words", "abstains", "late"),
    [
        (f"fashion10 --device {PARALLEL}fast --decisions 100", False, False),
        (f"fashion-adaptive --device {WALKS}fast --decisions 40 --confidence 0.8", True, False),
        (f"fashion10 --device {PARALLEL}fast&{STALLS} --decisions 100 --deadline-us 1000", False, True),
    ],
)
def test_osc_tells_what_the_run_records(words: str, abstains: bool, late: bool, tmp_path: Path) -> None:
    osc = pytest.importorskip("pythonosc.osc_bundle", reason="needs the test extra")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bonsai:
        bonsai.bind(("127.0.0.1", 0))
        bonsai.settimeout(0.2)
        port = bonsai.getsockname()[1]
        main(["run", *words.split(), "--osc", str(port), "--record", str(tmp_path / "r.pansrec"), "-q"])
        found: list[tuple[Any, ...]] = []
        while True:
            try:
                bundle: Any = osc.OscBundle(bonsai.recv(1 << 16))
            except TimeoutError:
                break
            assert {message.address for message in bundle} == {"/pans/decision"}
            found += [tuple(message.params) for message in bundle]
    rows, _ = recorded(tmp_path / "r.pansrec")
    assert found == rows
    assert not all(row[6] for row in rows)
    assert (any(row[2] == -1 for row in rows), any(row[6] for row in rows)) == (abstains, late)


def test_what_the_network_does_not_take_is_counted_and_waits_for_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    sender = OscSender("localhost:9")
    sender._socket.close()
    sender._socket = Mock(sendto=Mock(side_effect=[None, BlockingIOError]))
    some = [Decision(number, number, 0, 0, 0, 3, 1, -1, 0, 0.5, 0) for number in range(PER_DATAGRAM + 5)]
    sender.watch(NO_RUN, Output(some, [], None))
    sender.close()
    assert (sender.sent, sender.dropped) == (PER_DATAGRAM, 5)
    assert "5 decisions could not be sent" in capfd.readouterr().err
    for wrong in ("nowhere", "no.such.host.invalid:9000"):
        with pytest.raises(UsageError, match="--osc"):
            OscSender(wrong)


def engine() -> tuple[Any, Any]:
    needed = pytest.importorskip("bluesky.run_engine", reason="needs the extra ophyd")
    return needed.RunEngine({}), pytest.importorskip("pans.ophyd", reason="needs the extra ophyd").PansDetector


def events_of(run_engine: Any, detector: Any, number: int) -> tuple[list[tuple[str, dict[str, Any]]], list[int]]:
    """The documents of a plan of `number` events, and the time on the run's clock before each was triggered."""
    from bluesky import plan_stubs, plans

    asked: list[int] = []
    documents: list[tuple[str, dict[str, Any]]] = []

    def timed(detectors: Any) -> Any:
        asked.append(detector._run.now_ns())
        yield from plan_stubs.one_shot(detectors)

    run_engine(plans.count([detector], number, per_shot=timed), lambda *document: documents.append(document))
    return documents, asked


@pytest.mark.parametrize(
    ("bundle", "device", "number", "options"),
    [
        ("fashion10", f"{PARALLEL}fast", 100, {"shots": 3}),
        ("fashion-adaptive", f"{WALKS}fast", 100, {"confidence": 0.8}),
        ("fashion-adaptive", f"{WALKS}fast&{STALLS}", 100, {"deadline_us": 1000.0}),
        ("fashion-adaptive", f"{WALKS}real", 20, {}),
    ],
)
def test_a_plan_of_bluesky(bundle: str, device: str, number: int, options: dict[str, Any], tmp_path: Path) -> None:
    run_engine, detector_class = engine()
    detector = detector_class(bundle, device, out=tmp_path / "run", name="pans", **options)
    documents, asked = events_of(run_engine, detector, number)
    assert [name for name, _ in documents] == ["start", "descriptor", *["event"] * number, "stop"]
    keys, stop = documents[1][1]["data_keys"], documents[-1][1]
    assert (stop["exit_status"], stop["num_events"]) == ("success", {"primary": number})
    units = {"clicks": "clicks", "photons": "photoelectrons", "tick": "ticks"}
    assert {key.removeprefix("pans-"): found["units"] for key, found in keys.items() if "units" in found} == units
    assert all(key["shape"] == [] for key in keys.values())
    assert documents[1][1]["configuration"]["pans"]["data"]["pans-simulated"] is True

    rows, recording = recorded(tmp_path / "run" / "run.pansrec")
    assert detector.outcome.summary.decisions == len(rows)
    marks = [body for _, body in recording.messages if open_body(body)[0] == MARK]
    photons = {object_: light for _, object_, *_, light in (struct.unpack("<IIhHQQf", mark[8:]) for mark in marks)}
    ends_ns = {found: end_ns for found, end_ns, *_ in recording.timings}
    data = [document["data"] for name, document in documents if name == "event"]
    for event, asked_ns in zip(data, asked, strict=True):
        n = event["pans-number"]
        seen = [event[f"pans-{key}"] for key in ("number", "tick", "label", "probability", "clicks", "flags", "late")]
        assert tuple(seen) == rows[n]
        assert event["pans-abstained"] == (rows[n][2] == -1)
        assert event["pans-class_name"] == ("" if rows[n][2] == -1 else detector._classes[rows[n][2]])
        light = photons[int(recording.rows["object"][n])] * options.get("shots", 1)
        assert math.isclose(event["pans-photons"], light, rel_tol=1e-6)
        assert ends_ns[n - 1] >= asked_ns, "it began before it was triggered"
    numbers = [event["pans-number"] for event in data]
    assert numbers == sorted(set(numbers))
    assert any(event["pans-late"] for event in data) or STALLS not in device
    assert detector._run.accounts.late == []  # told, and forgotten


def test_a_device_that_is_lost_or_not_there_ends_a_plan(tmp_path: Path) -> None:
    run_engine, detector_class = engine()
    from bluesky.utils import FailedStatus

    lost = detector_class("fashion10", f"{PARALLEL}fast&faults=disconnect:100ms/1500ms", reconnect_s=0.0, name="lost")
    with pytest.raises(FailedStatus) as failed:
        events_of(run_engine, lost, 10_000)
    assert isinstance(failed.value.__cause__, LinkError)
    assert lost.outcome.summary.link_lost
    with pytest.raises(FailedStatus) as failed:
        events_of(run_engine, detector_class("fashion10", "serial:/dev/none", profile="oled-qcmos", name="none"), 1)
    assert isinstance(failed.value.__cause__, PansError)

    async def early() -> None:
        await detector_class("fashion10", f"{PARALLEL}fast", name="early").trigger()

    with pytest.raises(UsageError, match="not staged"):
        asyncio.run(early())
