"""`pans calibrate`: photon level, dark rates and non-uniformity of one instrument, or with --registration where a known target stands.

Both are measured through the ordinary session, in two stages: a short one, then one that is designed with what it found. A dated file comes
out.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_force
from pans.app.run.command import profile_of
from pans.app.run.files import files_of_url
from pans.base.console import emit, progress_bar, refuse_without, say, warn
from pans.base.errors import EXIT_ALERT, EXIT_FINE, EXIT_TIMING, LinkError, UsageError, as_usage_error
from pans.base.files import check_outputs
from pans.base.numbers import Range
from pans.instrument.profile import Profile, load_profile

FIRST_STAGE_SHARE = 0.1
CHANNELS_SHOWN = 8  # one line each; the file has all
PEAK_OFF = 0.2  # of the profile's brightness: beyond it the answer says so
OF_REGISTRATION = {"target": None, "page": None, "precision_px": 0.05, "precision_deg": 0.1}  # and their defaults


def _configure(parser: argparse.ArgumentParser) -> None:
    add, positive = parser.add_argument, Range(1e-4, 10).option
    before = "a clear field must stand before it (sim: scene=uniform), or the target (sim: scene=registration)"
    add("--device", required=True, help=f"device URL; {before}")
    add("--profile", help="hardware profile: a shipped name or a TOML file (default: the sim: URL's)")
    add("-o", "--out", required=True, type=Path, metavar="FILE", help="calibration file to write (.json)")
    add_force(parser)
    add("--seconds", type=Range(0.5, 86_400).option, default=10.0, help="instrument time (default 10)")
    seed = Range(0, (1 << 62) - 1, whole=True).option
    add("--seed", type=seed, default=1, help="of the random patterns (default 1)")
    add = parser.add_argument_group("registration (docs/how-to/calibrate.md#register-the-optical-table)").add_argument
    measured = "measure where a known target stands, sharpness, black level and flat field"
    add("--registration", action="store_true", help=measured)
    add("--target", type=Path, metavar="FILE", help="a picture or a scene (.npz) of the target (default: built in)")
    add("--page", type=Path, metavar="FILE", help="write a page with pictures of target and residuals (.html)")
    for flag, unit, words in (
        ("--precision-px", "PX", "half of the widest 95 %% interval of a shift that is accepted (default 0.05)"),
        ("--precision-deg", "DEG", "the same of the rotation (default 0.1)"),
    ):
        default = OF_REGISTRATION[flag[2:].replace("-", "_")]
        add(flag, type=positive, default=default, metavar=unit, help=words)


def _calibrate(args: argparse.Namespace) -> int:
    outputs = [args.out] if args.page is None else [args.out, args.page]
    check_outputs(outputs, inputs=[args.profile, args.target, *files_of_url(args.device)], force=args.force)
    if args.registration:
        return _register(args)
    refuse_without(args, "--registration", OF_REGISTRATION)
    from pans.calibrate.estimate import fit_light
    from pans.calibrate.measurement import (
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
    from pans.instrument.calibration_file import save_calibration

    profile = load_profile(args.profile or profile_of(args.device))
    exposure_us = calibration_exposure_us(profile)
    model, guess = count_model(profile, exposure_us), profile_level(profile, exposure_us)
    first = design_run(profile, LADDER, guess, FIRST_STAGE_SHARE * args.seconds, args.seed)
    core, _, doubts = _measure(args.device, profile, first)
    with as_usage_error():
        found = fit_light(joined_counts(counts_of(core, first, profile)), model).level
    if found.value <= 0 or not math.isfinite(found.value):
        what = "no exposure with light clicked" if found.value <= 0 else "every exposure with light clicked"
        remedy = "check the light path: a clear field must stand before the detector, neither dark nor blinding"
        raise UsageError(what, remedy=remedy)
    second = design_run(profile, TELLING, found.value, (1 - FIRST_STAGE_SHARE) * args.seconds, args.seed + 1)
    core, facts, more = _measure(args.device, profile, second)
    doubts += more
    with as_usage_error():
        values = calibration_values(counts_of(core, second, profile), model, second, profile)
    values |= {"contradictions": dict(doubts)} if doubts else {}
    values |= {"command": shlex.join(["pans", *sys.argv[1:]]), "seed": args.seed, "device": facts}
    sha256 = save_calibration(args.out, values, force=args.force)
    payload = {key: value for key, value in values.items() if key != "channels"}
    emit(args, {"calibration": str(args.out), "sha256": sha256, **payload}, _words(args.out, values))
    if doubts:
        return EXIT_TIMING
    off = abs(values["efficiency"]["relative_to_profile"] - 1.0) > PEAK_OFF
    return EXIT_ALERT if off or values["silent_channels"] else EXIT_FINE


def _measure(device: str, profile: Profile, design: Any) -> tuple[Any, dict[str, Any], Counter[str]]:
    """Run one design through the ordinary session; return the core with its sums, the device's facts and what contradicts the evidence."""
    from pans.calibrate.measurement import CalibrationCore
    from pans.live.loop import Job, Observers, run_live
    from pans.live.options import RunOptions
    from pans.live.stop import INTERRUPTED
    from pans.protocol.links import open_link
    from pans.report.summary import contradictions_of, exposure_fault

    core = CalibrationCore(design.plan, design.n_cycles)
    seconds = design.n_cycles * design.plan.cycle_us * 1e-6
    say(f"calibrating: {len(design.drives)} patterns, {seconds:.1f} s of instrument time")
    config = RunOptions(n_cycles=design.n_cycles, lease_ms=profile.timing.lease_ms)
    with progress_bar("exposures", design.n_cycles * design.plan.slots_per_cycle) as report:
        seen = Observers(lambda run, _: report(run.core.tracker.next_exposure), acts=False)
        job = Job(profile, design.bundle, design.plan, config)
        result = run_live(open_link(device), job, core, observers=seen)
    if result.ended == INTERRUPTED:
        raise KeyboardInterrupt(result.ended)
    if result.ended != "completed":
        raise LinkError(f"the calibration was not completed: {result.ended}", remedy="check the link and try again")
    if fault := exposure_fault(result.exposure_timing, result.stream["exposures"]):
        warn(fault)
    keep = {"serial", "firmware", "name", "simulated"}
    facts = {key: value for key, value in result.device.items() if key in keep}
    return core, facts, Counter(contradictions_of(result))


def _register(args: argparse.Namespace) -> int:
    from pans.calibrate.registration import (
        BUILT_IN,
        Registration,
        built_in_target,
        check_estimate,
        read_target,
        registration_values,
        registration_words,
        save_registration,
        target_sha256,
    )
    from pans.instrument.calibration_file import now_utc

    if args.page is not None:
        from pans.report.pages import need_extra

        need_extra()
    profile = load_profile(args.profile or profile_of(args.device))
    target = built_in_target() if args.target is None else read_target(args.target)
    measurement = Registration(profile, target, args.seconds, args.seed)
    say(f"registration: {measurement.words()}")
    measurement.prepare()
    first = measurement.first()
    core, _, doubts = _measure(args.device, profile, first)
    known = measurement.take(first, core)
    second = measurement.second(known)
    core, facts, more = _measure(args.device, profile, second)
    doubts += more
    found = measurement.take(second, core, known)
    if args.page is not None:
        from pans.report.pages import write_registration_page

        write_registration_page(args.page, measurement, found, simulated=bool(facts.get("simulated")), force=args.force)
    check_estimate(found, args.seconds, (args.precision_px, args.precision_deg))
    values = {
        "made_utc": now_utc().isoformat(timespec="seconds"),
        "profile": {"name": profile.name, "sha256": profile.sha256},
        "target": {"name": BUILT_IN if args.target is None else args.target.name, "sha256": target_sha256(target)},
        **registration_values(found, measurement.bench.shape),
        "exposure_us": second.plan.exposure_us,
        "instrument_seconds": sum(one.n_cycles * one.plan.cycle_us * 1e-6 for one in (first, second)),
        **({"contradictions": dict(doubts)} if doubts else {}),
        "command": shlex.join(["pans", *sys.argv[1:]]),
        "seed": args.seed,
        "device": facts,
    }
    sha256 = save_registration(args.out, values, force=args.force)
    emit(args, {"registration": str(args.out), "sha256": sha256, **values}, registration_words(args.out, values))
    return EXIT_TIMING if doubts else EXIT_FINE


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
    if 1 < len(values["channels"]) <= CHANNELS_SHOWN:
        for number, row in enumerate(values["channels"]):
            level = row["level_relative"]
            said = "light unknown" if level is None else f"{level:.3f} of the photon level"
            lines.append(f"  channel {number:<7} {said}, dark {row['dark_per_exposure']:.3g} per exposure")
    if values["silent_channels"]:
        lines.append(f"  SILENT          no click in light: channel {', '.join(map(str, values['silent_channels']))}")
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
