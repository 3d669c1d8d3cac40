"""`pans calibrate`: photon level, dark rates and non-uniformity of one instrument, measured through the ordinary session, into
a dated file.

Owns the command's arguments, its two stages and its answer; the design is calibration_run.py's, the estimate calibrate.py's, the file
calibration.py's.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, EXIT_TIMING, Command, add_force, emit, say
from pans.runtime.errors import LinkError, UsageError, as_usage_error
from pans.runtime.instrument.profile import Profile, load_profile
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

from .run import profile_of
from .run_files import files_of_url

FIRST_STAGE_SHARE = 0.1
PEAK_OFF = 0.2  # of the profile's brightness: beyond it the answer says so


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device", required=True, help="device URL; a clear field must stand before it (sim: scene=uniform)"
    )
    parser.add_argument("--profile", help="hardware profile: a shipped name or a TOML file (default: the sim: URL's)")
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="FILE", help="calibration file to write (.json)"
    )
    add_force(parser)
    parser.add_argument("--seconds", type=Range(0.5, 86_400).option, default=10.0, help="instrument time (default 10)")
    parser.add_argument(
        "--seed", type=Range(0, (1 << 63) - 1, whole=True).option, default=1, help="of the random patterns (default 1)"
    )


def _calibrate(args: argparse.Namespace) -> int:
    _check(args)
    from pans.runtime.core.calibration import (
        LADDER,
        TELLING,
        calibration_exposure_us,
        calibration_values,
        count_model,
        counts_of,
        design_run,
        joined_counts,
        profile_level,
    )
    from pans.runtime.instrument.calibration import save_calibration
    from pans.runtime.instrument.estimate import fit_light

    if not 0.5 <= args.seconds <= 86_400:
        raise UsageError(f"--seconds must be from 0.5 to 86400, found {args.seconds:g}")
    profile = load_profile(args.profile or profile_of(args.device))
    exposure_us = calibration_exposure_us(profile)
    model, guess = count_model(profile, exposure_us), profile_level(profile, exposure_us)
    first = design_run(profile, LADDER, guess, FIRST_STAGE_SHARE * args.seconds, args.seed)
    core, _, doubts = _measure(args.device, profile, first)
    with as_usage_error():
        found = fit_light(joined_counts(counts_of(core, first, profile)), model).level
    if found.value <= 0 or not math.isfinite(found.value):
        raise UsageError(
            "no exposure with light clicked" if found.value <= 0 else "every exposure with light clicked",
            remedy="check the light path: a clear field must stand before the detector, neither dark nor blinding",
        )
    second = design_run(profile, TELLING, found.value, (1 - FIRST_STAGE_SHARE) * args.seconds, args.seed + 1)
    core, facts, more = _measure(args.device, profile, second)
    doubts += more
    with as_usage_error():
        values = calibration_values(counts_of(core, second, profile), model, second, profile)
    values |= {"contradictions": dict(doubts)} if doubts else {}
    values |= {"command": shlex.join(["pans", *sys.argv[1:]]), "seed": args.seed, "device": facts}
    sha256 = save_calibration(args.out, values, force=args.force)
    payload = {
        "calibration": str(args.out),
        "sha256": sha256,
        **{key: value for key, value in values.items() if key != "channels"},
    }
    emit(args, payload, _words(args.out, values))
    if doubts:
        return EXIT_TIMING
    off = abs(values["efficiency"]["relative_to_profile"] - 1.0) > PEAK_OFF
    return EXIT_ALERT if off else EXIT_FINE


def _check(args: argparse.Namespace) -> None:
    """Refuse what cannot be written before anything is measured."""
    check_outputs([args.out], inputs=[args.profile, *files_of_url(args.device)], force=args.force)


def _measure(device: str, profile: Profile, design: Any) -> tuple[Any, dict[str, Any], Counter[str]]:
    """Run one design through the ordinary session; return the core with its sums, the device's facts and what contradicts the evidence."""
    from pans.runtime.core.calibration import CalibrationCore
    from pans.runtime.link.base import open_link
    from pans.runtime.live import RunConfig, run_live
    from pans.runtime.live.continuous import INTERRUPTED
    from pans.runtime.report.summary import contradictions_of

    core = CalibrationCore(design.plan, design.n_cycles)
    seconds = design.n_cycles * design.plan.cycle_us * 1e-6
    say(f"calibrating: {len(design.drives)} patterns, {seconds:.1f} s of instrument time")
    config = RunConfig(n_cycles=design.n_cycles, lease_ms=profile.timing.lease_ms)
    result = run_live(open_link(device), profile, design.bundle, design.plan, core, config)
    if result.ended == INTERRUPTED:
        raise KeyboardInterrupt(result.ended)
    if result.ended != "completed":
        raise LinkError(f"the calibration was not completed: {result.ended}", remedy="check the link and try again")
    keep = ("serial", "firmware", "name", "simulated")
    facts = {key: result.device[key] for key in keep if key in result.device}
    return core, facts, Counter(contradictions_of(result))


def _words(path: Path, values: dict[str, Any]) -> str:
    low, high = values["photons_per_level_ci"]
    spread, efficiency = values["non_uniformity"], values["efficiency"]
    half = "no upper bound" if high is None else f"±{50 * (high - low) / values['photons_per_level']:.2f} %"
    banner = "SIMULATED · " if values["device"].get("simulated") else ""
    found = "patterns differ" if spread["found"] else "no sign that patterns differ"
    level, dark, dark_ci = values["photons_per_level"], values["dark_per_exposure"], values["dark_ci"]
    lines = [
        f"{banner}{path}",
        f"  photon level    {level:.6g} photoelectrons per level and exposure ({values['exposure_us']:g} us), 95 % {half}",
        f"  peak            {values['peak_photoelectrons_hz']:.6g} photoelectrons/s, "
        f"{efficiency['relative_to_profile']:.4f} of the profile's",
        f"  dark            {dark:.3g} per exposure, 95 % {dark_ci[0]:.3g} to {dark_ci[1]:.3g}",
        f"  non-uniformity  {spread['relative']:.2%} ({found}, p = {spread['p_value']:.2g})",
    ]
    if doubts := values.get("contradictions"):
        kinds = ", ".join(f"{what} {count}" for what, count in sorted(doubts.items()))
        lines.append(f"  FAULT           {sum(doubts.values())} messages contradict the evidence: {kinds}")
    return "\n".join(lines)


CALIBRATE = Command(
    "measure photon level and dark rates of an instrument, into a dated file",
    _configure,
    _calibrate,
    examples=("pans calibrate --device serial:/dev/ttyACM0 --profile my-lab.toml -o lab.json",),
)
