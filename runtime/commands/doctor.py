"""`pans devices` and `pans doctor`: where instruments may be, and what in this machine stands in their way.

Owns the commands' arguments and wording; the checks are doctor.py's.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, emit, say

from .doctor_checks import Finding, examine, schemes, serial_ports, udev_rule, usb_devices


def _configure_devices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--no-usb", action="store_true", help="do not look at the USB bus")


def _devices(args: argparse.Namespace) -> int:
    ports = serial_ports() + ([] if args.no_usb else usb_devices())
    lines = [f"{port.url:<36} {port.state:<14} {port.description}" for port in ports]
    lines += [f"    remedy: {port.remedy}" for port in ports if port.remedy]
    lines = lines or ["no serial port and no USB device was found"]
    lines.append(f"schemes: {', '.join(schemes())}   (without hardware: sim:ideal, simserial:ideal, simusb:ideal)")
    emit(args, {"devices": [asdict(port) for port in ports], "schemes": schemes()}, "\n".join(lines))
    return EXIT_FINE


def _configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--udev", action="store_true", help="print the udev rule that gives access to instruments, and end"
    )
    parser.add_argument(
        "--realtime", action="store_true", help="measure for about 10 s what each real-time setting brings here"
    )
    parser.add_argument(
        "--warm",
        action="store_true",
        help="compile all kernels into the cache, on all cores, so that a first run need not",
    )


def _doctor(args: argparse.Namespace) -> int:
    if args.udev:
        emit(args, {"udev": udev_rule()}, udev_rule().rstrip())
        return EXIT_FINE
    if args.warm:
        return _warm(args)
    findings = examine()
    if args.realtime:
        return _realtime(args, findings)
    lines = []
    for finding in findings:
        mark = "ok" if finding.ok else "FAIL" if finding.needed else "note"
        lines.append(f"{mark:<5}{finding.check:<22} {finding.found}")
        if not finding.ok:
            lines.append(f"     remedy: {finding.remedy}")
    broken = [finding.check for finding in findings if finding.needed and not finding.ok]
    lines.append(f"{'cannot run: ' + ', '.join(broken) if broken else 'ready to run'}")
    emit(args, {"findings": [asdict(finding) for finding in findings], "ready": not broken}, "\n".join(lines))
    return EXIT_ALERT if broken else EXIT_FINE


def _realtime(args: argparse.Namespace, findings: list[Finding]) -> int:
    from .doctor_realtime import findings_of, measure, payload_of, settings_of, table_text

    machine, found = measure()
    rows = settings_of(machine, found)
    broken = [finding.check for finding in findings if finding.needed and not finding.ok]
    told = [asdict(finding) for finding in [*findings, *findings_of(rows)]]
    payload = {"findings": told, "ready": not broken, "realtime": payload_of(rows, found)}
    emit(args, payload, table_text(rows, found))
    return EXIT_ALERT if broken else EXIT_FINE


def _warm(args: argparse.Namespace) -> int:
    from pans.runtime.operate.warm import warm, words_of

    say("pans: compiling the kernels of a run: once per machine and version")
    found = warm()
    emit(args, {"warm": found}, words_of(found))
    return EXIT_FINE if all(row["ok"] for row in found["jobs"]) else EXIT_ALERT


DEVICES = Command(
    "list ports and USB devices, and whether they can be opened",
    _configure_devices,
    _devices,
    examples=("pans devices",),
)
DOCTOR = Command(
    "check this machine: ports, permissions, libraries, clock, scheduler",
    _configure_doctor,
    _doctor,
    examples=(
        "pans doctor",
        "pans doctor --realtime",
        "pans doctor --warm",
        "pans doctor --udev | sudo tee /etc/udev/rules.d/70-pans.rules",
    ),
)
