"""`pans tune`: a bundle, a device and labels in; patterns adjusted on the instrument itself, and a report, out."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_new_bundle
from pans.base.console import emit
from pans.base.errors import EXIT_FINE, EXIT_INTERRUPTED, UsageError
from pans.base.files import check_outputs
from pans.base.numbers import Range

from .refit import light_words, percent_words

PARTS = {
    "shift": ("right_px", "down_px"),
    "rotation": ("rotation_deg",),
    "scale": ("scale",),
    "bends": ("stretch_px", "shear_px", "keystone_right_px", "keystone_down_px"),
    "brightness": ("brightness",),
}
USUAL = "shift,rotation,scale"
OBJECTS_RANGE = Range(100, 1 << 17, whole=True)
OBJECTS_USUAL = 1000
PHOTONS_RANGE, MINUTES_RANGE = Range(1.0, 1e15), Range(1e-3, 1e5)
DRIVES = ("auto", "device", "host")


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bundle", type=Path, help="the bundle whose patterns are adjusted")
    add("--device", required=True, help="device URL; each trial opens it again")
    add("--profile", help="hardware profile: a shipped name or a TOML file (default: the sim: URL's)")
    add("--labels", type=Path, metavar="CSV", help="object,label per line (default: the truth in the device's marks)")
    objects = f"objects of each trial (default: the labels' or the scene's, at most {OBJECTS_USUAL})"
    add("--objects", type=OBJECTS_RANGE.option, default=0, metavar="N", help=objects)
    only = f"what is tuned: of {', '.join(PARTS)} (default {USUAL})"
    add("--only", type=_parameters, default=USUAL, metavar="PARTS", help=only)
    photons, minutes = "most photons of all trials together", "most minutes of the instrument"
    add("--photons", type=PHOTONS_RANGE.option, default=math.inf, metavar="N", help=photons)
    add("--minutes", type=MINUTES_RANGE.option, default=math.inf, metavar="N", help=minutes)
    add("--drive", default="auto", choices=DRIVES, help="of an automaton: who chooses each pattern")
    add("--resume", action="store_true", help="continue from NEW.pans.tune.json")
    add_new_bundle(parser, metavar="NEW.pans")


def _parameters(parts: str) -> tuple[str, ...]:
    chosen = [part.strip() for part in parts.split(",")]
    if len(set(chosen) & PARTS.keys()) != len(chosen):
        raise argparse.ArgumentTypeError(f"{parts!r}, allowed: some of {', '.join(PARTS)}, each once")
    return tuple(name for part in PARTS if part in chosen for name in PARTS[part])


def _run(args: argparse.Namespace) -> int:
    from pans.bundle.sensor import bundle_path, load_bundle, write_bundle

    path, checkpoint = bundle_path(args.bundle), args.out.with_name(f"{args.out.name}.tune.json")
    if args.resume and not checkpoint.is_file():
        raise UsageError(f"{checkpoint}: there is no checkpoint", remedy="leave --resume out")
    replaces = args.force or args.resume
    if checkpoint.exists() and not replaces:
        raise UsageError(
            f"{checkpoint}: a tuning was begun here", remedy="continue it with --resume, or begin anew with --force"
        )
    check_outputs([args.out, checkpoint], inputs=[path, args.labels], force=replaces)
    from pans.calibrate.refit import Cost, Tuning, read_labels
    from pans.instrument.profile import load_profile
    from pans.live.stop import stop_signals

    bundle, sha256 = load_bundle(path)
    if bundle.analyser is not None:
        raise UsageError(f"{bundle.name} is passive: nothing is shown that could be adjusted", remedy="use pans refit")
    if bundle.picture_shape is not None:
        raise UsageError(f"{bundle.name} returns pictures", remedy="tune a bundle that decides among classes")
    if not args.profile and not args.device.startswith("sim:"):
        raise UsageError(
            f"no profile for {args.device}", remedy="give the instrument's hardware profile with --profile"
        )
    profile = load_profile(args.profile or args.device[4:].partition("?")[0])
    with stop_signals(continuous=False) as stop:
        labels, labels_sha256 = None, None
        if args.labels is not None:
            known = read_labels(args.labels, bundle.classes)
            if known.names_recordings:
                raise UsageError(
                    f"{args.labels}: names recordings, there are none", remedy="write object,label per line"
                )
            labels, labels_sha256 = known.by_recording[""], known.sha256
        n_objects = args.objects or _count(args.device, labels)
        facts = {
            "bundle_sha256": sha256,
            "profile_sha256": profile.sha256,
            "device": args.device,
            "labels_sha256": labels_sha256,
            "objects": n_objects,
            "parameters": list(args.only),
        }
        budget = Cost(args.photons, 60 * args.minutes)
        bench = args.device, profile, bundle, n_objects, labels, args.drive, stop
        tuned, report = Tuning(*bench, args.only, budget, checkpoint, facts).run(resume=args.resume)
        written = write_bundle(tuned, args.out, force=replaces)
    payload = {"bundle": str(args.out), "sha256": written, "checkpoint": str(checkpoint), **report}
    emit(args, payload, _words_of(payload))
    return EXIT_INTERRUPTED if report["interrupted"] else EXIT_FINE


def _count(device: str, labels: Mapping[int, int | None] | None) -> int:
    from pans.calibrate.refit import scene_size

    found = max(labels) + 1 if labels else scene_size(device)
    if found < OBJECTS_RANGE.low:
        raise UsageError(
            f"{found} objects, allowed: {OBJECTS_RANGE.low:g} or more",
            remedy="say with --objects how many pass in one trial",
        )
    return min(found, OBJECTS_USUAL)


def _words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    from pans.calibrate.refit import Move

    kind, spent, compared = "SIMULATED: " if report["simulated"] else "", report["spent"], report["comparison"]
    lines = [
        f"{kind}{report['trials']} trials of {report['objects']} objects, {report['accepted']} steps taken: "
        + Move(**report["move"]).words(),
        f"ended: {report['ended']}; {spent['photons_or_clicks']:.4g} photons and "
        f"{spent['instrument_minutes']:.3g} minutes of the instrument",
    ]
    if report["resolution"] is not None:
        lines.append(f"with these objects a step is seen from a gain of {report['resolution']:.2g} in log loss on")
    if compared is None:
        lines.append("not compared: interrupted" if report["changed"] else "not compared: the old patterns stay")
    else:
        for name in ("old", "new"):
            held, everything = (percent_words(compared[of][f"accuracy_{name}"]) for of in ("held_out", "all_objects"))
            lines.append(f"  {name}  held out {held}, all objects {everything} {light_words(compared[name])}")
        if not report["changed"]:
            lines.append("the old patterns stay: the new ones are not better on fresh clicks")
    return "\n".join([*lines, f"{report['bundle']}  SHA-256 {report['sha256'][:16]}"])


TUNE = Command(
    "adjust patterns on the instrument itself, by the clicks of labelled objects",
    _configure,
    _run,
    examples=(
        "pans tune my.pans --device serial:/dev/ttyACM0 --profile my-lab.toml --labels truth.csv --minutes 20 -o my-tuned.pans",
        "pans tune my.pans --device serial:/dev/ttyACM0 --profile my-lab.toml --labels truth.csv -o my-tuned.pans --resume",
    ),
)
