"""`pans devices`, `pans doctor` and traces: every finding has its remedy, and nothing is opened to find out."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import Pans
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from pans.app.doctor import command as doctor
from pans.app.doctor.command import Finding, examine, port_state, serial_ports
from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import LinkError, UsageError
from pans.protocol.links.base import TracedLink
from pans_sim.ports.serve import open_sim


def test_doctor_on_this_machine(pans: Pans) -> None:
    findings = pans("doctor")["findings"]
    assert {"python", "numba", "onnxruntime", "libusb", "numba cache"} <= {finding["check"] for finding in findings}
    assert all(finding["ok"] or finding["remedy"] for finding in findings)
    assert main(["doctor"]) == 0
    assert "ready to run" in pans.said().out


def test_what_is_needed_and_missing_is_an_alert(monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    def check_broken() -> Iterator[Finding]:
        raise ImportError("no module named numba")
        yield

    def check_odd() -> Iterator[Finding]:
        raise RuntimeError("odd")
        yield

    findings = examine((check_broken, check_odd, doctor.check_python))
    assert {finding.check: finding.ok for finding in findings} == {"broken": False, "odd": False, "python": True}
    assert all(finding.remedy for finding in findings if not finding.ok)
    monkeypatch.setattr("pans.app.doctor.command.examine", lambda: findings)
    assert main(["doctor"]) == 1
    assert "cannot run: broken" in pans.said().out


def test_a_busy_computer_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for load, ok in ((0.4, True), (6.2, False)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, load, load))
        (found,) = doctor.check_load()
        assert (found.check, found.ok, found.found) == ("load", ok, f"{load} on 2 cores in the last minute")
        assert ("end other programs" in found.remedy) != ok


def test_the_udev_rule_is_printed(pans: Pans) -> None:
    assert main(["doctor", "--udev"]) == 0
    assert pans.said().out.strip() == (SHIPPED / doctor.RULE).read_text().strip()
    assert int(doctor.RULE.partition("-")[0]) < 73  # later, systemd has already handed out the access rights


def test_devices_lists_ports_by_their_lasting_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, pans: Pans
) -> None:
    device = tmp_path / "ttyACM0"
    device.touch()
    port = ListPortInfo(str(device))
    port.vid, port.pid, port.serial_number, port.description = 0x1209, 1, "A1", "an instrument"
    gone = ListPortInfo(str(tmp_path / "ttyS9"))
    monkeypatch.setattr(list_ports, "comports", lambda: [port, gone])
    wanted = {"serial:1209:0001:A1": "free", f"serial:{gone.device}": "not there"}
    assert {state.url: state.state for state in serial_ports()} == wanted
    listed = pans("devices", "--no-usb")
    assert listed["devices"][0]["vid_pid_serial"] == "1209:0001:A1"
    assert {"serial", "usb", "sim", "simusb", "simserial"} <= set(listed["schemes"])


def test_no_permission_and_busy_are_seen_without_opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    folder = tmp_path / "proc" / "4711" / "fd"
    folder.mkdir(parents=True)
    (folder.parent / "comm").write_text("minicom\n")
    assert port_state(str(device), tmp_path / "proc") == ("free", "")
    os.symlink(device, folder / "3")
    assert port_state(str(device), tmp_path / "proc") == ("busy", "close minicom (process 4711) first")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    state, remedy = port_state(str(device), tmp_path / "proc")
    assert state == "no permission"
    assert "udev" in remedy


def test_a_trace_has_both_directions_and_times(tmp_path: Path) -> None:
    path = tmp_path / "trace.txt"
    link = TracedLink(open_sim("sim:ideal?scene=uniform&pace=fast"), path)
    link.write(b"\x01\x02\0")
    assert link.read(0.25) == b""
    link.reopen()
    link.close()
    with pytest.raises(LinkError):
        link.read(0.1)
    first, *lines = path.read_text().splitlines()
    assert first.startswith("0.000000000 # sim:ideal")
    assert lines[:2] == ["0.000000000 > 01 02 00", "0.250000000 # opened again"]
    with pytest.raises(UsageError, match="cannot be written"):
        TracedLink(open_sim("sim:ideal?scene=uniform&pace=fast"), tmp_path / "none" / "trace.txt")


def test_a_run_writes_its_trace(tmp_path: Path, pans: Pans) -> None:
    path = tmp_path / "trace.txt"
    words = ["demo", "--pace", "fast", "--trials", "1", "--seconds", "0.5", "--out", str(tmp_path)]
    main([*words, "--trace", str(path), "--json"])
    summary = json.loads(pans.said().out)
    sent, received = (
        [line.split(maxsplit=2) for line in path.read_text().splitlines() if line.split()[1] == mark] for mark in "><"
    )
    assert len(sent) > 10
    assert sum(len(bytes.fromhex(line[2])) for line in received) == summary["link"]["bytes_in"]
    times = [float(line[0]) for line in sent]
    assert times == sorted(times)


MAC = """
import ctypes.util, os, resource, select, sys
import numba, onnxruntime, serial.tools.list_ports, usb.core  # which look at the system themselves
import pans.decide.kernel.receive
sys.platform = "darwin"
of_linux = {os: ("sched_", "SCHED_", "eventfd", "memfd", "posix_f"), select: ("epoll",), resource: ("RUSAGE_TH",)}
for module, start in of_linux.items():
    for name in [name for name in vars(module) if name.startswith(start) and name != "sched_yield"]:
        delattr(module, name)
from pans.app.main import main
code = main(sys.argv[1:])
sys.stdout.flush()
os._exit(code)
"""


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (
            ["doctor"],
            0,
            "not here: real-time priority (SCHED_FIFO), locked memory (mlockall), binding to a core (--core)",
        ),
        (["demo", "--realtime", "--seconds", "0.3", "--deadline-us", "1e8"], 0, "darwin has no real-time priority"),
        (["simulate", "--profile", "dmd-spad", "--core", "0"], 2, "this system cannot pin threads to cores"),
    ],
)
def test_what_is_of_linux_only_is_named_at_once(words: list[str], code: int, said: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MAC, *words], capture_output=True, text=True, cwd=tmp_path, timeout=300
    )
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert done.returncode == code


def test_the_disk_that_a_recording_takes_is_that_of_a_run(tmp_path: Path, pans: Pans) -> None:
    words = (
        "--device",
        "sim:oled-qcmos?pace=fast&seed=1",
        "--decisions",
        "400",
        "--out",
        tmp_path / "run",
        "--no-realtime",
    )
    summary = pans("run", "fashion10", *words)
    recording = (tmp_path / "run" / "run.pansrec").stat().st_size - (SHIPPED / "fashion10.pans").stat().st_size
    hours = summary["decisions"] * 11 * 16_666.7e-6 / 3600
    assert doctor.disk_mib_per_hour("fashion10", "oled-qcmos") == pytest.approx(recording / 2**20 / hours, rel=0.5)
