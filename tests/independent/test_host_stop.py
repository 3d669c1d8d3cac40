"""A host that is stopped beyond its lease and comes back: all that arrived is on record or counted, by the independent readers' count."""

from __future__ import annotations

import json
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from lab_bench import FASHION, profile_text
from lab_bundle import read_bundle
from lab_decisions import decide_again
from lab_frames import COMMAND, HELLO, STATUS, FrameCutter, Message
from lab_recording import read_recording
from test_lab_firmware import firmware_process

STREAM = (0x90, 0x91, 0x92)
STOPPED_S = 3.0


class Opening:
    """What one opening of the link has carried, as the trace says: every message of an armed session, and what was damaged."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.from_device, self.from_host = FrameCutter(), FrameCutter()
        self.session, self.armed, self.foreign = 0, False, 0

    def take(self, direction: str, data: bytes) -> None:
        if direction == ">":
            for kind, session, payload in self.from_host.feed(data):
                self.session = session if kind == HELLO else self.session
                self.armed |= kind == COMMAND and payload[4] == 3
            return
        for message in self.from_device.feed(data):
            self.foreign += message[1] != self.session
            if self.armed and message[1] == self.session and message[0] in (*STREAM, STATUS):
                self.messages.append(message)


def read_trace(path: Path) -> list[Opening]:
    """Return the openings of a trace file."""
    openings = [Opening()]
    for line in path.read_text().splitlines():
        _, direction, rest = line.split(" ", 2)
        if direction == "#" and rest == "opened again":
            openings.append(Opening())
        elif direction in "<>":
            openings[-1].take(direction, bytes.fromhex(rest))
    return openings


def from_first_block(messages: list[Message]) -> list[Message]:
    """Leave out what a session says before its first block: a STATUS that came just before ARM may be on record or not."""
    begun: set[int] = set()
    kept = []
    for message in messages:
        if message[0] in STREAM:
            begun.add(message[1])
        if message[1] in begun:
            kept.append(message)
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("stopped_s", [0.6, STOPPED_S])
def test_what_arrived_while_the_host_stood_still_is_accounted_for(tmp_path: Path, stopped_s: float) -> None:
    (tmp_path / "lab.toml").write_text(profile_text("sequential", 900.0))
    seed = secrets.randbelow(1 << 32)
    print(f"seed {seed}")
    with firmware_process("--seed", str(seed)) as (url, kept):
        words = [
            "run",
            str(FASHION),
            "--device",
            url,
            "--profile",
            str(tmp_path / "lab.toml"),
            "--seconds",
            str(stopped_s + 2),
        ]
        words += ["--deadline-us", "1e6"]
        words += ["--no-realtime", "--json", "--out", str(tmp_path), "--trace", str(tmp_path / "trace.txt")]
        call = [
            sys.executable,
            "-c",
            "import sys; from pans.runtime.cli import main; sys.exit(main(sys.argv[1:]))",
            *words,
        ]
        with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as host:
            wait_for_bytes(tmp_path / "trace.txt", 300_000)
            host.send_signal(signal.SIGSTOP)
            time.sleep(stopped_s)
            host.send_signal(signal.SIGCONT)
            said, errors = host.communicate(timeout=60)
    print(errors)
    summary, books = json.loads(said), kept[0]
    recording = read_recording((tmp_path / "run.pansrec").read_bytes())
    rows = decide_again(recording, read_bundle(recording.bundle))
    assert rows.tobytes() == recording.rows.tobytes()
    openings = read_trace(tmp_path / "trace.txt")
    arrived = [message for opening in openings for message in opening.messages]
    recorded = [(body[0], int.from_bytes(body[4:8], "little"), body[8:]) for _, body in recording.messages]
    stream = summary["stream"]
    print(len(arrived), len(recorded), stream, summary["link"], books)
    assert from_first_block(arrived) == from_first_block(recorded)
    counted = stream["messages"] + stream["repeated"] + stream["malformed"]
    assert sum(kind in STREAM for kind, _, _ in arrived) == counted
    assert sum(opening.from_device.damaged for opening in openings) == 0
    lost = [event["reason"] for event in recording.events if event["kind"] == "link_lost"]
    assert all("lease" in reason for reason in lost), (
        lost
    )  # it was the host that stood still, not the device that fell silent
    assert books["lease_expiries"] == summary["reconnects"] == int(stopped_s > 1)


def wait_for_bytes(path: Path, size: int) -> None:
    """Wait until the run is well under way."""
    until = time.monotonic() + 30
    while not path.exists() or path.stat().st_size < size:
        assert time.monotonic() < until, "the run did not begin"
        time.sleep(0.01)
