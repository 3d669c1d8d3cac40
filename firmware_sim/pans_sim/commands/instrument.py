"""`pans instrument`: a projector and a counter of the lab as an instrument behind TCP or a pseudo-terminal; its URL is the first line."""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
import time

from pans.app.command import Command
from pans.base.console import emit, say
from pans.base.errors import EXIT_FINE, UsageError
from pans.base.machine import check_core
from pans.instrument.profile import load_profile
from pans_sim.ports.shell import open_port, serve

from .simulate import leave

FIRMWARE = "pans-instrument 1"
PARTS = {"projector": "projectors", "counter": "counters", "objects": "objects"}


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--projector", metavar="NAME[,SETTING=VALUE,...]", help="alp, or module:Class of your own")
    parser.add_argument("--counter", metavar="NAME[,SETTING=VALUE,...]", help="tagger, or module:Class of your own")
    parser.add_argument("--objects", metavar="module:Class[,...]", help="what brings objects and knows their class")
    parser.add_argument("--profile", help="the instrument's hardware profile")
    parser.add_argument("--listen", default="tcp:127.0.0.1:0", help="tcp:127.0.0.1:PORT (default: any port) or pty")
    parser.add_argument("--core", type=int, metavar="N", help="pin to core N and busy-wait; uses 100 %% of that core")
    parser.add_argument("--list", action="store_true", help="name the adapters that are installed")


def _run(args: argparse.Namespace) -> int:
    from pans_sim.pc_instrument import Apparatus, adapter_names, make_adapter
    from pans_sim.pc_instrument.core import Core, build_library, limits_of

    if args.list:
        known = {kind: adapter_names(kind) for kind in PARTS.values()}
        emit(args, known, "\n".join(f"{kind}: {', '.join(names) or 'none'}" for kind, names in known.items()))
        return EXIT_FINE
    for name in ("projector", "counter", "profile"):
        if getattr(args, name) is None:
            raise UsageError(f"--{name} is needed", remedy="`pans instrument --list` names the adapters")
    check_core(args.core)
    profile, library = load_profile(args.profile), build_library()
    signal.signal(signal.SIGTERM, leave)
    with contextlib.ExitStack() as opened:
        parts = {}
        for name, kind in PARTS.items():
            if getattr(args, name) is not None:
                parts[name] = make_adapter(kind, getattr(args, name), profile)
                opened.callback(getattr(parts[name], "close", lambda: None))
        hardware = Apparatus(profile, **parts)
        facts = {"profile": profile.name, "projector": args.projector[:60], "counter": args.counter[:60]}
        simulated = any(getattr(part, "simulated", False) for part in parts.values())
        serial = "-".join(getattr(part, "serial", "") for part in parts.values()).strip("-") or "pc"
        limits = limits_of(
            profile, facts, firmware=FIRMWARE, serial=serial, epoch=time.time_ns(), simulated=simulated, gate_pulses=1
        )
        core = Core(limits, hardware, hardware.now(), library)
        port = open_port(args.listen)
        opened.callback(port.close)
        emit(args, {"device": port.url, "simulated": simulated, **facts}, port.url)
        say(f"{profile.name} by {args.projector} and {args.counter}; Ctrl-C ends it")
        gc.freeze()  # what was made so far is never collected
        try:
            serve(core, hardware.clock, port, lambda: False, args.core, realtime=not simulated)
        finally:
            with contextlib.suppress(Exception):
                hardware.dark()
    return EXIT_FINE


INSTRUMENT = Command(
    "serve a projector and a counter of your lab as an instrument that other programs open as a device",
    _configure,
    _run,
    examples=(
        "pans instrument --projector alp --counter tagger --profile alp-tagger --listen tcp:127.0.0.1:4100",
        "pans instrument --projector alp,version=4.4 --counter tagger,clicks=3,synch=4 --profile lab.toml",
    ),
)
