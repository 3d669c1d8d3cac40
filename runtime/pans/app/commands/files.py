"""The commands on files: `pans verify`, `pans info`, `pans bundle`. Checks are report/files/verify.py's, facts report/files/facts.py's."""

from __future__ import annotations

import argparse
import hashlib
import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.app.command import Command, add_new_bundle
from pans.base import __version__
from pans.base.console import emit, one_line
from pans.base.errors import EXIT_ALERT, EXIT_FINE, EXIT_USAGE, DamagedFileError, UsageError, as_usage_error
from pans.base.numbers import Range

if TYPE_CHECKING:  # the help of a command must not load what it works with
    from numpy.typing import NDArray

    from pans.bundle.making import QuantisedPatterns
    from pans.bundle.sensor import Bundle
    from pans.instrument.profile import Profile
    from pans.report.files import FileVerdict

DEFAULT_LEVELS = 124
ANY_FILE = "a bundle, a recording, a calibration, or a profile (file or shipped name)"
VALUE_CHARACTERS = 200


def _configure_verify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("paths", nargs="+", metavar="PATH", help=ANY_FILE)


def _verify(args: argparse.Namespace) -> int:
    from pans.record.reading import is_of_parts
    from pans.report.files import verify_file, verify_parts

    groups = [verify_parts(path) if is_of_parts(path) else [verify_file(path)] for path in args.paths]
    verdicts = [verdict for group in groups for verdict in group]
    payload = {
        "ok": all(one.ok for one in verdicts),
        "alerts": [{"path": one.path, "message": text} for one in verdicts for text in one.alerts],
        "violations": [{"path": one.path, "message": text} for one in verdicts for text in one.violations],
        "files": [{key: getattr(one, key) for key in ("path", "kind", "ok", "damaged", "cut")} for one in verdicts],
    }
    emit(args, payload, "\n".join(line for one in verdicts for line in _verdict_lines(one)))
    if any(one.damaged for one in verdicts):
        return EXIT_USAGE
    return EXIT_FINE if payload["ok"] else EXIT_ALERT


def _verdict_lines(verdict: FileVerdict) -> Iterator[str]:
    only_cut = verdict.cut and len(verdict.violations) == 1
    bad = "CUT" if only_cut else "VIOLATED" if verdict.violations else "alerts"
    word = "ok" if verdict.ok else "DAMAGED" if verdict.damaged else bad
    yield f"{word:<8}  {verdict.kind:<9}  {verdict.path}"
    yield from (f"          violation: {text}" for text in verdict.violations)
    yield from (f"          alert: {text}" for text in verdict.alerts)
    if verdict.damaged:
        yield f"          remedy: {DamagedFileError.usual_remedy}"
    elif only_cut:
        yield "          remedy: use it as far as it goes: `pans replay`, `report` and `export` read its whole blocks"
    elif verdict.violations:
        yield "          remedy: do not rely on this file; make it again with the present version"


def _configure_info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help=ANY_FILE)


def _info(args: argparse.Namespace) -> int:
    from pans.report.files import file_facts

    facts = file_facts(args.path)
    rows = list(_flat(facts))
    width = max(len(key) for key, _ in rows)
    emit(args, facts, "\n".join(f"{key:<{width}}  {value}" for key, value in rows))
    return EXIT_USAGE if facts.get("damage") else EXIT_FINE


def _flat(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (dotted key, printable value); a stranger's text must not steer the terminal."""
    for key, value in facts.items():
        name = one_line(f"{prefix}{key}", VALUE_CHARACTERS)
        if isinstance(value, dict):
            yield from _flat(value, f"{name}.")
        elif isinstance(value, list | tuple):
            yield name, one_line(", ".join(str(item) for item in value), VALUE_CHARACTERS)
        elif key == "simulated" and value is True:
            yield name, "SIMULATED"
        elif value is not None and value != "":
            yield name, one_line(value, VALUE_CHARACTERS)


def _configure_bundle(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    patterns = "floats (d_f, pixels) in photons, or a folder of grey PNG pictures in the order of their names"
    add("--patterns", required=True, type=Path, metavar="P.npy", help=patterns)
    white = "of PNG pictures: photons per exposure through a white pixel and a clear object"
    add("--photons-at-white", type=Range(1e-9, 1e9).option, metavar="N", help=white)
    add("--head", type=Path, metavar="H.onnx", help="click means (n, d_f) -> scores (n, classes), float32")
    add("--table", type=Path, metavar="T.npy", help="scores (2**d_f, classes); bit i of a row is pattern i")
    numbers = "K photon numbers, 0 to K - 1 or more (default 2: no click and a click)"
    outcomes = f"what head or table take of an exposure: {numbers}"
    add("--outcomes", type=Range(2, 16, whole=True).option, default=2, metavar="K", help=outcomes)
    add("--classes", required=True, metavar="a,b,...", help="class names in the order of the scores")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--levels", type=int, metavar="N", help=f"intensity levels (default {DEFAULT_LEVELS})")
    profile = "take the levels of this profile, and check that it can expose them"
    group.add_argument("--profile", metavar="P", help=profile)
    add("--image-shape", metavar="HxW", help="rows x columns of a pattern (default: square, else one row)")
    dither = "error diffusion instead of rounding (default auto: up to 8 levels)"
    add("--dither", choices=("auto", "on", "off"), default="auto", help=dither)
    data = "say what the levels cost in accuracy on these labelled images: .npz, class folders or a shipped scene"
    add("--data", metavar="SCENE", help=data)
    add("--task", default="custom", metavar="NAME", help="what is decided (default: custom)")
    add("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    add_new_bundle(parser)


def _bundle(args: argparse.Namespace) -> int:
    from pans.base.files import check_outputs, read_file
    from pans.bundle.making import DITHER_LEVELS_MAX, quantise_patterns
    from pans.bundle.sensor import BackEnd, Shown, make_bundle, write_bundle
    from pans.decide.plan import exposure_us
    from pans.instrument.profile import load_profile

    check_outputs([args.out], inputs=[args.patterns, args.head, args.table, args.profile], force=args.force)
    if args.head is None and args.table is None:
        raise UsageError("neither --head nor --table was given", remedy="give one of them, or both")
    profile = load_profile(args.profile) if args.profile else None
    levels = profile.projector.levels if profile else DEFAULT_LEVELS if args.levels is None else args.levels
    patterns, provenance = _inputs(args, profile)
    shape = _image_shape(args.image_shape, patterns.shape[1])
    dithered = args.dither == "on" or (args.dither == "auto" and levels <= DITHER_LEVELS_MAX)
    with as_usage_error():
        quantised = quantise_patterns(patterns, levels, dither=shape if dithered else None)
    rounding = {**_quantisation_facts(quantised), "dithered": dithered}
    bundle = make_bundle(
        name=args.name or args.out.stem,
        task=args.task,
        classes=[name.strip() for name in args.classes.split(",")],
        image_shape=shape,
        optics=Shown(levels, quantised.pattern_levels, quantised.photons_per_level),
        back_end=BackEnd(
            head_onnx=read_file(args.head) if args.head else None,
            table=_load_array(args.table) if args.table else None,
            outcomes=args.outcomes,
        ),
        provenance={**provenance, "quantisation": rounding},
    )
    exposure = {"exposure_us": exposure_us(profile, bundle)} if profile else {}
    cost = _cost(args, patterns, bundle, exposure.get("exposure_us", 0.0), profile) if args.data else {}
    sha256 = write_bundle(bundle, args.out, force=args.force)
    facts = {**rounding, **exposure, **cost, "levels": levels, "patterns": bundle.n_features}
    emit(args, {"bundle": str(args.out), "sha256": sha256, **facts}, "\n".join(_bundle_lines(args.out, sha256, facts)))
    return EXIT_FINE


def _inputs(args: argparse.Namespace, profile: Profile | None) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return the patterns, and where everything came from; no time of day, so that the same inputs give the same bytes."""
    from pans.base.files import read_file

    patterns, pictures = _patterns(args)
    files = {"patterns": None if pictures else args.patterns, "head": args.head, "table": args.table}
    sources = {
        role: {"file": path.name, "sha256": hashlib.sha256(read_file(path)).hexdigest()}
        for role, path in files.items()
        if path is not None
    }
    made_by = {"made_by": "pans bundle", "pans_version": __version__, "inputs": {**pictures, **sources}}
    return patterns, made_by | ({"profile": {"name": profile.name, "sha256": profile.sha256}} if profile else {})


def _cost(
    args: argparse.Namespace, patterns: NDArray[Any], bundle: Bundle, exposure_us: float, profile: Profile | None
) -> dict[str, Any]:
    """What rounding costs on the objects of --data, with the profile's detector, or one that counts every photon."""
    from pans.base.files import read_labelled
    from pans.bundle.making import quantisation_cost

    data = read_labelled(args.data)
    if data.classes and data.classes != bundle.classes:
        there, allowed = ", ".join(data.classes[:5]), ", ".join(bundle.classes[:5])
        raise UsageError(f"{args.data} has the classes {there}, allowed with --classes: {allowed}")
    with as_usage_error():
        cost = quantisation_cost(patterns, bundle, data.images, data.labels, exposure_us, profile)
    figures = {name: getattr(cost, name) for name in ("accuracy_given", "accuracy_shown", "objects", "trials")}
    return {**figures, "accuracy_difference_se": cost.difference_se, "simulated": True}


def _patterns(args: argparse.Namespace) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return the patterns in photons (d_f, pixels), and of a folder of pictures what it was; its pictures have the shape too."""
    if not args.patterns.is_dir():
        if args.photons_at_white is not None:
            remedy = "leave it out: arrays are in photons"
            raise UsageError("--photons-at-white has no effect on an array", remedy=remedy)
        patterns = _load_array(args.patterns)
        if patterns.ndim != 2:
            raise UsageError(f"{args.patterns}: shape {patterns.shape}, allowed: (d_f, pixels)")
        return patterns, {}
    from pans.bundle.making import read_pattern_pngs

    if args.photons_at_white is None:
        raise UsageError("pictures do not say how much light white is", remedy="say it with --photons-at-white")
    grey, (height, width) = read_pattern_pngs(args.patterns)
    args.image_shape = args.image_shape or f"{height}x{width}"
    facts = {"folder": args.patterns.name, "pictures": len(grey), "photons_at_white": args.photons_at_white}
    facts["sha256"] = hashlib.sha256(grey.tobytes()).hexdigest()
    return grey * args.photons_at_white, {"patterns": facts}


def _quantisation_facts(quantised: QuantisedPatterns) -> dict[str, Any]:
    wanted = quantised.illumination_wanted
    return {
        "photons_per_level": quantised.photons_per_level,
        "quantisation_error_max_photons": quantised.error_max,
        "illumination": quantised.illumination,
        "illumination_error_relative": (quantised.illumination - wanted) / wanted,
        "pixels_lost": quantised.pixels_lost,
    }


def _bundle_lines(out: Path, sha256: str, facts: Mapping[str, Any]) -> Iterator[str]:
    how = "error diffusion" if facts["dithered"] else "rounding"
    yield f"{out}  SHA-256 {sha256}"
    yield (
        f"  {facts['patterns']} patterns on {facts['levels']} levels of {facts['photons_per_level']:.6g} photons; "
        f"{how} is off by at most {facts['quantisation_error_max_photons']:.3g} photons per pixel"
    )
    yield (
        f"  illumination {facts['illumination']:.6g} photons ({facts['illumination_error_relative']:+.2%} by it); "
        f"{facts['pixels_lost']} lit pixels became dark"
    )
    if "accuracy_given" in facts:
        change = facts["accuracy_shown"] - facts["accuracy_given"]
        yield (
            f"  SIMULATED accuracy {facts['accuracy_given']:.2%} with the patterns as given, "
            f"{facts['accuracy_shown']:.2%} on these levels: "
            f"{100 * change:+.2f} ± {100 * facts['accuracy_difference_se']:.2f} points on {facts['objects']} objects"
        )
    if "exposure_us" in facts:
        yield f"  exposure {facts['exposure_us']:.6g} us"


def _image_shape(text: str | None, pixels: int) -> tuple[int, int]:
    if text is None:
        side = math.isqrt(pixels)
        return (side, side) if side * side == pixels else (1, pixels)
    height, _, width = text.lower().partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) * int(width) == pixels):
        raise UsageError(f"--image-shape {text!r} does not fit {pixels} pixels", remedy="give HxW with H * W = pixels")
    return int(height), int(width)


def _load_array(path: Path) -> NDArray[Any]:
    """Read one .npy array of floats; its header is held against the file's size before anything is allocated."""
    import numpy as np

    from pans.base.files import npy_header, read_file

    data = read_file(path)
    stream = io.BytesIO(data)
    try:
        shape, fortran, dtype = npy_header("it", stream)
        if dtype.kind != "f":
            raise ValueError(f"dtype {dtype}, allowed: floats")
        wanted = math.prod(shape) * dtype.itemsize
        if len(data) - stream.tell() != wanted:
            raise ValueError(f"{len(data) - stream.tell()} bytes of data, its shape {shape} needs {wanted}")
    except ValueError as error:
        what = f"{path}: not a readable .npy array: {error}"
        raise DamagedFileError(what, remedy="write it with numpy.save") from error
    return np.frombuffer(data, dtype=dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


VERIFY = Command(
    "check bundles, recordings, calibrations and profiles",
    _configure_verify,
    _verify,
    examples=("pans verify pans-runs/latest/run.pansrec my.pans my-lab.toml",),
)
INFO = Command(
    "show what a file holds",
    _configure_info,
    _info,
    examples=("pans info fashion10", "pans info pans-runs/latest/run.pansrec --json"),
)
BUNDLE = Command(
    "make a bundle from any trained model",
    _configure_bundle,
    _bundle,
    examples=(
        "pans bundle --patterns P.npy --head H.onnx --classes a,b,c --profile oled-qcmos -o my.pans",
        "pans bundle --patterns P.npy --table T.npy --classes a,b --levels 2 --data scene.npz -o my.pans",
    ),
)
