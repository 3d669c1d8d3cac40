"""Options of `pans run` in groups: passing objects, calibration and dark counts, running for days.

Owns how these are spelled and what makes no sense; never loads what a run needs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pans.runtime.cli import warn
from pans.runtime.errors import UsageError
from pans.runtime.flow.settings import FlowSettings, read_flow, with_gate
from pans.runtime.instrument.calibration import MAX_AGE_H
from pans.runtime.live.config import DarkSettings
from pans.runtime.live.continuous import Continuous
from pans.runtime.ranges import Range

MIB = 1 << 20
DISK_RESERVE_MB = 64.0  # half a minute of the fastest shipped profile, and room for the summary
# What the numbers of a run may be. 10**12 decisions are thirty years at 1000 a second; 1e9 s are as many years.
RANGES = {
    "shots": Range(1, 1 << 20, whole=True),
    "trials": Range(1, 1 << 20, whole=True),
    "decisions": Range(0, 10**12, whole=True),
    "seconds": Range(0, 1e9),
    "deadline_us": Range(0, 1e9),
    "dark_slots": Range(0, 65534, whole=True),
    "reconnect_s": Range(0, 1e6),
    "gate_delay_us": Range(0, 1e6),
    "pool": Range(1, 64, whole=True),
    "calibration_max_age_h": Range(1e-9, 1e6),
    "rotate_mb": Range(1e-6, 1e6),
    "keep_mb": Range(1e-6, 1e9),
    "disk_reserve_mb": Range(0, 1e9),
    "confidence": Range(0.0, 1.0),
    "dose_cap": Range(1e-9, 1e15),
    "seed": Range(0, (1 << 63) - 1, whole=True),
}


def add_walk_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of an automaton to `pans run` and `pans demo`."""
    group = parser.add_argument_group("automata (docs/how-to/automata.md)")
    group.add_argument(
        "--drive",
        default="auto",
        choices=("auto", "device", "host"),
        help="who chooses the next pattern by the clicks: the device where it can (auto), the device, or the host",
    )
    group.add_argument(
        "--confidence",
        type=RANGES["confidence"].option,
        default=0.0,
        metavar="C",
        help="decide as soon as a class is this probable, and abstain where none is at the end (default: walk to the end)",
    )


def add_flow_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a flow to `pans run`."""
    group = parser.add_argument_group("objects in flow (docs/how-to/flow.md)")
    group.add_argument("--flow", metavar="cells|tape|FILE", help="settings of the flow: shipped ones or a TOML file")
    group.add_argument(
        "--gate-class", action="append", default=[], metavar="NAME", help="class to pulse for (repeatable, or a,b)"
    )
    group.add_argument(
        "--gate-delay-us",
        type=RANGES["gate_delay_us"].option,
        metavar="US",
        help="from leaving to the pulse (default: the settings', 900)",
    )
    group.add_argument(
        "--act",
        default="device",
        metavar="URL",
        help="what makes the pulse: device (default: its GATE command), a second instrument's URL (tcp:HOST:PORT too), or NAME:...",
    )
    group.add_argument(
        "--act-profile",
        metavar="PROFILE",
        help="hardware profile of the second instrument (default: that of the first)",
    )
    group.add_argument(
        "--pool",
        type=RANGES["pool"].option,
        metavar="N",
        help="windows side by side whose evidence is added (default: the settings', 1)",
    )


OF_FLOW: Mapping[str, Any] = {
    "gate_class": [],
    "gate_delay_us": None,
    "act": "device",
    "act_profile": None,
    "pool": None,
}  # and their defaults


def refuse_without(args: argparse.Namespace, needed: str, defaults: Mapping[str, Any]) -> None:
    """Refuse options that have no effect without the option `needed`."""
    for name, default in defaults.items():
        if getattr(args, name, default) != default:
            raise UsageError(
                f"--{name.replace('_', '-')} has no effect without {needed}", remedy=f"add {needed}, or leave it out"
            )


def flow_of(args: argparse.Namespace) -> FlowSettings | None:
    """Return the settings that the command line asks for, None without --flow."""
    if getattr(args, "flow", None) is None:
        refuse_without(args, "--flow", OF_FLOW)
        return None
    classes = tuple(name for part in args.gate_class for name in part.split(",") if name)
    settings = with_gate(read_flow(args.flow), classes, args.gate_delay_us)
    return settings if args.pool is None else replace(settings, pool=args.pool)


def add_dark_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to `pans run`."""
    group = parser.add_argument_group(
        "calibration and dark counts (docs/how-to/calibrate.md, docs/how-to/dark-counts.md)"
    )
    group.add_argument(
        "--calibration", type=Path, metavar="FILE", help="what `pans calibrate` measured on this instrument"
    )
    group.add_argument(
        "--registration",
        type=Path,
        metavar="FILE",
        help="correct the patterns for the table that `pans calibrate --registration` measured",
    )
    group.add_argument(
        "--calibration-max-age-h",
        type=RANGES["calibration_max_age_h"].option,
        default=MAX_AGE_H,
        metavar="H",
        help=f"older is stale: a calibration is warned about, a registration refused (default {MAX_AGE_H:g})",
    )
    group.add_argument(
        "--on-dark",
        default="warn",
        choices=("warn", "tables", "mask", "abstain"),
        help="when dark counts have changed: report it (default), decide with adapted tables, leave channels out, or abstain",
    )


def dark_of(args: argparse.Namespace) -> DarkSettings:
    """Return what the command line asks for; `pans demo` has no instrument to calibrate, and asks for nothing."""
    if not hasattr(args, "calibration"):
        return DarkSettings()
    if args.calibration is None and args.registration is None:
        refuse_without(args, "--calibration or --registration", {"calibration_max_age_h": MAX_AGE_H})
    return DarkSettings(
        args.calibration, args.calibration_max_age_h, args.on_dark, warns=True, registration=args.registration
    )


def add_continuous_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to `pans run`."""
    group = parser.add_argument_group("running for days")
    group.add_argument(
        "--rotate-mb",
        type=RANGES["rotate_mb"].option,
        metavar="N",
        help="record in parts of about N MiB (default: one file)",
    )
    group.add_argument(
        "--keep-mb",
        type=RANGES["keep_mb"].option,
        metavar="N",
        help="delete the oldest parts above N MiB (default: keep all)",
    )
    group.add_argument(
        "--disk-reserve-mb",
        type=RANGES["disk_reserve_mb"].option,
        default=DISK_RESERVE_MB,
        metavar="N",
        help=f"stop in order before less than N MiB are free on the recording's disk (default {DISK_RESERVE_MB:g}; 0: never)",
    )
    group.add_argument("--state", type=Path, metavar="FILE", help="write the run's state there as JSON, each second")
    group.add_argument(
        "--metrics",
        default="",
        metavar="HOST:PORT",
        help="serve figures for Prometheus; a port alone: this machine only",
    )
    group.add_argument(
        "--metrics-public", action="store_true", help="let other machines read the figures; there is no password"
    )


def add_serve_options(parser: argparse.ArgumentParser) -> None:
    """Add the live page's options to `pans run` and `pans demo`."""
    group = parser.add_argument_group("live page (docs/how-to/live-view.md)")
    group.add_argument(
        "--serve", default="", metavar="HOST:PORT", help="show the run as a web page; a port alone: this machine only"
    )
    group.add_argument(
        "--serve-public", action="store_true", help="let other machines see the page; there is no password"
    )


def serve_of(args: argparse.Namespace) -> str:
    """Return the address of the live page, checked."""
    return _address_of(args.serve, args.serve_public, "--serve")


def continuous_of(args: argparse.Namespace) -> Continuous:
    """Return what the options ask for; UsageError for what makes no sense. Commands without the options ask for nothing."""
    rotate_mb, keep_mb = getattr(args, "rotate_mb", None) or 0.0, getattr(args, "keep_mb", None) or 0.0
    if keep_mb and not rotate_mb:
        raise UsageError("--keep-mb deletes parts, and there are none", remedy="say how large with --rotate-mb")
    if rotate_mb and getattr(args, "on_dark", "warn") != "warn":
        raise UsageError(
            f"--rotate-mb with --on-dark {args.on_dark}: what the guard has learnt is not in a part, which could not be replayed",
            remedy="record without parts, or use --on-dark warn",
        )
    from pans.runtime.record.part_keeper import PartLimits

    limits = PartLimits(max(1, round(rotate_mb * MIB)), round(keep_mb * MIB)) if rotate_mb else None
    reserve = round(getattr(args, "disk_reserve_mb", DISK_RESERVE_MB) * MIB)
    return Continuous(limits, getattr(args, "state", None), _metrics_of(args), reserve)


def _metrics_of(args: argparse.Namespace) -> str:
    """Return the address for metrics, checked."""
    return _address_of(getattr(args, "metrics", ""), getattr(args, "metrics_public", False), "--metrics")


def _address_of(address: str, public: bool, option: str) -> str:
    """Return the address, checked; one that others can reach is said aloud."""
    if not address:
        if public:
            raise UsageError(f"{option}-public has no effect without {option}", remedy=f"add {option}, or leave it out")
        return ""
    from pans.runtime.watch.metrics import check_address, is_public

    check_address(address, public=public, option=option)
    if is_public(address):
        warn(f"other machines can read the figures at {address}; there is no password")
    return address
