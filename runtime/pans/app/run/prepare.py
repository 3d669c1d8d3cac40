"""What a run needs but its link, made at once while the port opens: bundle, plan, core, guard, header."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pans.base.console import check_options, option_fields, refuse_without, say, warn
from pans.base.errors import UsageError
from pans.base.files import RUNS
from pans.base.machine import check_core
from pans.decide.flow import FlowSettings, read_flow, with_gate
from pans.instrument.calibration_file import MAX_AGE_H
from pans.instrument.profile import Profile, load_profile
from pans.live.options import FLOW, RunOptions

from .files import part_limits, recording_header

if TYPE_CHECKING:
    from pans.bundle.automaton import DoseCap
    from pans.bundle.sensor import Bundle
    from pans.calibrate.registration import InUse
    from pans.decide import Follower
    from pans.live.loop import DarkRun, FlowRun, Job

ROUNDING = 1e-9  # of a dose cap: a sum of light is known to so many digits


def check_together(options: RunOptions) -> None:
    """Raise UsageError for options that are out of range, or make no sense together."""
    check_options(options)
    check_core(options.core)
    if options.flow is None:
        of_flow = {one.name: one.default for one, _ in option_fields(options) if one.metadata["group"] == FLOW}
        refuse_without(options, "--flow", of_flow)
    elif flow_of(options) is not None and (options.decisions or options.trials != 1):
        remedy = "--seconds, in place of --decisions and --trials"
        raise UsageError("a flow has as many decisions as objects pass", remedy=remedy)
    if options.calibration is None and options.registration is None:
        refuse_without(options, "--calibration or --registration", {"calibration_max_age_h": MAX_AGE_H})
    if options.keep_mb and not options.rotate_mb:
        raise UsageError("--keep-mb deletes parts, and there are none", remedy="say how large with --rotate-mb")
    if options.keep_runs_mb:
        if options.out_root is None or not options.keep_mb:
            remedy = "leave --out and --record out, and bound each run with --rotate-mb and --keep-mb"
            raise UsageError(f"--keep-runs-mb deletes earlier runs in {RUNS} that are in parts", remedy=remedy)
        if options.keep_runs_mb < 2 * options.keep_mb:
            what = f"--keep-runs-mb {options.keep_runs_mb:g} is below twice --keep-mb {options.keep_mb:g}"
            raise UsageError(what, remedy="leave room for this run and the one before")
    if options.rotate_mb and options.on_dark != "warn":
        raise UsageError(
            f"--rotate-mb with --on-dark {options.on_dark}: what the guard has learnt is not in a part, which could not be replayed",
            remedy="record without parts, or use --on-dark warn",
        )
    part_limits(options)
    _check_address(options.serve, options.serve_public, "--serve")
    if options.serve_control and (options.serve_public or not options.serve):
        what = "has no effect without --serve" if not options.serve else "and --serve-public: there is no password"
        remedy = (
            "add --serve HOST:PORT, or leave it out" if not options.serve else "use a tunnel (docs/how-to/live-view.md)"
        )
        raise UsageError(f"--serve-control {what}", remedy=remedy)
    _check_address(options.metrics, options.metrics_public, "--metrics")


def _check_address(address: str, public: bool, option: str) -> None:
    """Check where a page is served; one that others can reach is said aloud."""
    if not address:
        if public:
            raise UsageError(f"{option}-public has no effect without {option}", remedy=f"add {option}, or leave it out")
        return
    from pans.live.watch import check_address, is_public

    check_address(address, public=public, option=option)
    if is_public(address):
        warn(f"other machines can read the figures at {address}; there is no password")


def flow_of(options: RunOptions) -> FlowSettings | None:
    """Return the settings of the flow that is asked for; None without one."""
    if options.flow is None:
        return None
    classes = tuple(name for part in options.gate_class for name in part.split(",") if name)
    settings = with_gate(read_flow(options.flow), classes, options.gate_delay_us)
    return settings if options.pool is None else replace(settings, pool=options.pool)


def dose_of(options: RunOptions, bundle: Bundle, profile: Profile) -> DoseCap | None:
    """Return what each walk of an automaton may bring, so that no object receives more than the dose cap; None of fixed patterns.

    UsageError where the cap cannot be kept: for fixed patterns that bring more, passive bundles, objects in flow, and patterns that a
    registration changes.
    """
    if not options.dose_cap:
        return None
    if bundle.analyser is not None or options.flow is not None or options.registration is not None:
        raise UsageError(
            "--dose-cap is for patterns that are displayed to one object after another as the bundle states them: not for passive "
            "optics, --flow or --registration",
            remedy="leave --dose-cap out, or the other one",
        )
    if bundle.automaton is not None:
        from pans.bundle.automaton import STATES_MAX, DoseCap

        states = min(profile.projector.automaton_states or STATES_MAX, STATES_MAX)
        return DoseCap(options.dose_cap / options.trials, states)
    light = bundle.illumination() * options.shots * options.trials
    if light > options.dose_cap * (1 + ROUNDING):
        raise UsageError(
            f"{bundle.name} sends {light:.6g} photoelectrons of illumination to an object ({bundle.n_features} patterns, "
            f"{options.shots} shots, {options.trials} trials), --dose-cap allows {options.dose_cap:.6g}",
            remedy="pans order BUNDLE --by dose --dose-cap N makes a bundle of as many patterns as stay below; or fewer shots or trials",
        )
    return None


@dataclass(frozen=True, slots=True)
class Prepared:
    """One run: all that it needs but its link."""

    profile: Profile  # without what a calibration changes in it
    job: Job
    core: Follower
    dark: DarkRun
    registration: InUse | None
    flow_run: FlowRun | None
    header: dict[str, Any]  # of the recording
    expected_decisions: int  # 0: as many as come
    frames: int  # of a decision; a flow adds windows

    @property
    def bundle(self) -> Bundle:
        """With the patterns that are displayed."""
        return self.job.bundle

    @property
    def illumination(self) -> float:
        """What the patterns of one decision send, in photoelectrons."""
        return self.bundle.illumination() * self.frames


def prepare(options: RunOptions, profile: Profile) -> Prepared:
    """Prepare the run that `options` ask for on an instrument of `profile`; tells of what is unusual."""
    from pans.bundle.backends import make_decider
    from pans.bundle.sensor import load_bundle
    from pans.decide.plan import build_plan, detector_warnings, drive_words
    from pans.decide.still import Core
    from pans.instrument.calibration_file import now_utc
    from pans.live.loop import DarkRun, FlowRun, Job, open_actuator

    flow, shots, seconds = flow_of(options), options.shots, options.seconds
    bundle, bundle_sha256 = load_bundle(options.bundle)
    dose = dose_of(options, bundle, profile)
    decider = make_decider(bundle, shots=shots, backend=options.backend, confidence=options.confidence, dose=dose)
    registration: InUse | None = None
    if options.registration is not None:
        from pans.calibrate.registration import in_use

        registration = in_use(options.registration, bundle, profile, now_utc(), options.calibration_max_age_h)
        say(f"pans: {registration.words()}")
        bundle = registration.shown
    placed = registration.profile if registration and not options.calibration else profile
    dark = DarkRun.of(options, placed)
    n_objects = -(-options.decisions // options.trials)
    expected_decisions = n_objects * options.trials
    frames = shots if flow is None else shots * flow.pool
    core: Follower
    flow_run: FlowRun | None = None
    if flow is not None:
        from pans.decide.flow import plan_flow

        plan, flow_core, n_cycles = plan_flow(dark.profile, bundle, decider, flow, shots, seconds)
        seconds = 0.0  # the end of a flow is in its plan
        flow_core.guard = dark.guard(plan, bundle, shots, flow=True)
        second = load_profile(options.act_profile) if options.act_profile else profile
        core, flow_run = flow_core, FlowRun(flow_core, open_actuator(options.act, second))
    else:
        plan = build_plan(
            dark.profile,
            bundle,
            shots_per_object=shots * options.trials,
            dark_slots_per_cycle=options.dark_slots,
            order=options.order,
            drive=options.drive,
            automaton=decider.automaton,
        )
        if plan.automaton is not None:
            say(f"pans: {drive_words(dark.profile, bundle, plan)}")
        n_cycles = n_objects * plan.cycles_per_object
        dark.expect(plan, bundle, options.trials)
        core = Core(plan, decider, shots, n_cycles, dark.guard(plan, bundle, shots))
    header = recording_header(options, profile, bundle_sha256, decider, n_objects, plan)
    parts = {"dark": dark, "registration": registration, "flow": flow_run}
    header["config"] |= {name: part.header() for name, part in parts.items() if part is not None}
    of_loop = replace(options, n_cycles=n_cycles, lease_ms=profile.timing.lease_ms, seconds=seconds)
    for warning in (*dark.warnings, *detector_warnings(dark.profile, bundle, plan.exposure_us)):
        warn(warning)
    job = Job(dark.profile, bundle, plan, of_loop)
    return Prepared(profile, job, core, dark, registration, flow_run, header, expected_decisions, frames)
