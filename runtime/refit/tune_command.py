"""`pans tune`: a bundle, a device and labels in; patterns adjusted on the instrument itself, and a report, out."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, add_new_bundle, emit
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

from .command import light_words, percent_words

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
    parser.add_argument("bundle", type=Path, help="the bundle whose patterns are adjusted")
    parser.add_argument("--device", required=True, help="device URL; each trial opens it again")
    parser.add_argument("--profile", help="hardware profile: a shipped name or a TOML file (default: the sim: URL's)")
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="CSV",
        help="object,label per line (default: the truth that the device's marks tell)",
    )
    parser.add_argument(
        "--objects",
        type=OBJECTS_RANGE.option,
        default=0,
        metavar="N",
        help=f"objects of each trial (default: the labels' or the scene's, at most {OBJECTS_USUAL})",
    )
    parser.add_argument(
        "--only", default=USUAL, metavar="PARTS", help=f"what is tuned: of {', '.join(PARTS)} (default {USUAL})"
    )
    parser.add_argument(
        "--photons",
        type=PHOTONS_RANGE.option,
        default=math.inf,
        metavar="N",
        help="most photons of all trials together",
    )
    parser.add_argument(
        "--minutes", type=MINUTES_RANGE.option, default=math.inf, metavar="N", help="most minutes of the instrument"
    )
    parser.add_argument("--drive", default="auto", choices=DRIVES, help="of an automaton: who chooses each pattern")
    parser.add_argument("--resume", action="store_true", help="go on from NEW.pans.tune.json")
    add_new_bundle(parser, metavar="NEW.pans")


def _run(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import bundle_path, load_bundle, write_bundle

    names = _parameters(args.only)
    path, checkpoint = bundle_path(args.bundle), args.out.with_name(f"{args.out.name}.tune.json")
    if args.resume and not checkpoint.is_file():
        raise UsageError(f"{checkpoint}: there is no checkpoint", remedy="leave --resume out")
    replaces = args.force or args.resume
    if checkpoint.exists() and not replaces:
        raise UsageError(
            f"{checkpoint}: a tuning was begun here", remedy="go on with --resume, or begin anew with --force"
        )
    check_outputs([args.out, checkpoint], inputs=[path, args.labels], force=replaces)
    from pans.runtime.instrument.profile import load_profile
    from pans.runtime.live.continuous import stop_signals

    from .tune import Bench, Budget, Tuning

    bundle, sha256 = load_bundle(path)
    if bundle.analyser is not None:
        raise UsageError(f"{bundle.name} is passive: nothing is shown that could be adjusted", remedy="use pans refit")
    if bundle.picture_shape is not None:
        raise UsageError(f"{bundle.name} returns pictures", remedy="tune a bundle that decides among classes")
    profile = load_profile(args.profile or _profile_of(args.device))
    with stop_signals(continuous=False) as stop:
        labels, labels_sha256 = _labels(args, bundle.classes)
        n_objects = args.objects or _count(args.device, labels)
        bench = Bench(args.device, profile, bundle, n_objects, labels, stop, args.drive)
        facts = {
            "bundle_sha256": sha256,
            "profile_sha256": profile.sha256,
            "device": args.device,
            "labels_sha256": labels_sha256,
            "objects": n_objects,
            "parameters": list(names),
        }
        tuning = Tuning(bench, names, Budget(args.photons, 60 * args.minutes), checkpoint, facts)
        tuned, report = tuning.run(resume=args.resume)
        written = write_bundle(tuned, args.out, force=replaces)
    payload = {"bundle": str(args.out), "sha256": written, "checkpoint": str(checkpoint), **report}
    emit(args, payload, _words_of(payload))
    return EXIT_INTERRUPTED if report["interrupted"] else EXIT_FINE


def _parameters(parts: str) -> tuple[str, ...]:
    chosen = [part.strip() for part in parts.split(",")]
    unknown = [part for part in chosen if part not in PARTS]
    if unknown or len(set(chosen)) != len(chosen):
        raise UsageError(f"--only {parts!r}, allowed: some of {', '.join(PARTS)}, each once")
    return tuple(name for part in PARTS if part in chosen for name in PARTS[part])


def _profile_of(device: str) -> str:
    if device.startswith("sim:"):
        return device[4:].partition("?")[0]
    raise UsageError(f"no profile for {device}", remedy="give the instrument's hardware profile with --profile")


def _labels(args: argparse.Namespace, classes: tuple[str, ...]) -> tuple[dict[int, int | None] | None, str | None]:
    if args.labels is None:
        return None, None
    from .clicks import read_labels

    found = read_labels(args.labels, classes)
    if found.names_recordings:
        raise UsageError(f"{args.labels}: names recordings, there are none", remedy="write object,label per line")
    return dict(found.by_recording[""]), found.sha256


def _count(device: str, labels: dict[int, int | None] | None) -> int:
    from .tune import scene_size

    found = max(labels) + 1 if labels else scene_size(device)
    if found < OBJECTS_RANGE.low:
        raise UsageError(
            f"{found} objects, allowed: {OBJECTS_RANGE.low:g} or more",
            remedy="say with --objects how many pass in one trial",
        )
    return min(found, OBJECTS_USUAL)


def _words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    kind = "SIMULATED: " if report["simulated"] else ""
    from .tune import Move

    move = Move(**report["move"])
    spent = report["spent"]
    lines = [
        f"{kind}{report['trials']} trials of {report['objects']} objects, {report['accepted']} steps taken: {move.words()}",
        f"ended: {report['ended']}; {spent['photons_or_clicks']:.4g} photons and "
        f"{spent['instrument_minutes']:.3g} minutes of the instrument",
    ]
    if report["resolution"] is not None:
        lines.append(f"with these objects a step is seen from a gain of {report['resolution']:.2g} in log loss on")
    compared = report["comparison"]
    if compared is None:
        lines.append("not compared: the old patterns stay" if not report["changed"] else "not compared: interrupted")
    else:
        for name in ("old", "new"):
            here = compared["held_out"][f"accuracy_{name}"]
            lines.append(
                f"  {name}  held out {percent_words(here)}, all objects {percent_words(compared['all_objects'][f'accuracy_{name}'])} "
                f"{light_words(compared[name])}"
            )
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
