"""What a test needs to run against the simulator: a profile, a bundle and a plan, made from nothing and small.

Public: a lab's own package may use it in the tests of its drivers and back ends, with `open_link("sim:ideal?scene=uniform&pace=fast")`.

>>> profile, bundle, plan = small_setup()
>>> profile.name, bundle.classes, plan.n_patterns
('ideal', ('a', 'b', 'c'), 4)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pans.bundle.automaton import reachable_automaton
from pans.bundle.sensor import BackEnd, Bundle, Shown, make_bundle, with_expected
from pans.decide.plan import Plan, build_plan
from pans.instrument.profile import Profile, load_profile

N_PATTERNS = 4
EXPOSURE_US = 100.0


def small_setup(mode: str = "sequential") -> tuple[Profile, Bundle, Plan]:
    """Return an instrument, a bundle and a plan that put many small frames on the wire.

    `mode` is sequential or parallel; or an automaton with binary patterns that the device follows (device-driven) or the host names
    (host-driven), with -counts behind it over photon numbers, with -detectors over the clicks of two that are read at once.
    """
    driven, _, what = mode.partition("-driven")
    if driven in ("device", "host"):
        bundle, profile = small_automaton_bundle(what=what), load_profile("ideal")
        projector = replace(profile.projector, automaton_states=16, dwell_steps=4, levels=2)
        detector = replace(profile.detector, channels=2 if what == "-detectors" else 1)
        timing = replace(profile.timing, host_turn_us=50.0)
        profile = replace(profile, projector=projector, detector=detector, timing=timing)
        plan = build_plan(profile, bundle, shots_per_object=4, drive=driven)
        return profile, bundle, replace(plan, block_exposures=min(2, plan.block_exposures))
    profile = load_profile("ideal")
    if mode == "parallel":
        detector = replace(profile.detector, channels=N_PATTERNS)
        profile = replace(profile, mode="parallel", detector=detector)
    bundle = small_bundle(profile, EXPOSURE_US)
    plan = build_plan(profile, bundle, shots_per_object=4)
    return profile, bundle, replace(plan, block_exposures=2 if mode == "sequential" else 1)


def small_bundle(profile: Profile, exposure_us: float) -> Bundle:
    """Return a bundle of four random patterns of 2 x 2 pixels, three classes and a random table, for `profile`."""
    rng = np.random.default_rng(1)
    top = profile.projector.levels - 1
    levels = rng.integers(0, top // 3, (N_PATTERNS, 4)).astype(np.uint16)
    levels[0, 0] = top
    return make_bundle(
        name="small",
        task="small",
        classes=("a", "b", "c"),
        image_shape=(2, 2),
        optics=Shown(top + 1, levels, exposure_us * 1e-6 * profile.projector.peak_photoelectrons_hz / top),
        back_end=BackEnd(table=rng.normal(size=(1 << N_PATTERNS, 3)).astype(np.float32)),
        provenance={},
    )


# name, seed, and the successors of each state after each reading: clicks of one detector, photon numbers, clicks of two
_WALKS: dict[str, tuple[str, int, list[list[int]]]] = {
    "": ("small automaton", 2, [[1, 2], [3, 4], [4, 6], [5, 5], [5, 7], [8, 9]]),
    "-counts": (
        "small counting automaton",
        3,
        [[1, 2, 2], [3, 4, 4], [4, 3, 6], [5, 5, 7], [5, 7, 10], [8, 9, 10]],
    ),
    "-detectors": (
        "small automaton of two detectors",
        4,
        [[1, 2, 2, 1], [3, 4, 4, 3], [4, 3, 6, 4], [5, 5, 7, 5], [5, 7, 10, 11], [8, 9, 10, 11]],
    ),
}


def small_automaton_bundle(levels: int = 2, exposure_us: float = EXPOSURE_US, what: str = "") -> Bundle:
    """Return a bundle of an automaton of six states and four slots: one edge ends early, walks meet again, states share patterns.

    Patterns have 2 x 2 pixels; the light is that of the profile `ideal`. The expected figures are in range, but nobody's measurement.
    `what` is the automaton's kind, as in `small_setup`.
    """
    name, seed, successors = _WALKS[what]
    rng, pattern = np.random.default_rng(seed), [0, 1, 2, 1, 2 if what == "-detectors" else 3, 0]
    posteriors = rng.dirichlet(np.full(3, 0.6), 1 + max(map(max, successors)))
    automaton = reachable_automaton(pattern, [4, 2, 1, 4, 3, 2], 4, successors, posteriors, what == "-counts")
    patterns = rng.integers(0, levels, (4, 4))
    patterns[:, 0] = levels - 1
    top_hz = load_profile("ideal").projector.peak_photoelectrons_hz
    bundle = make_bundle(
        name=name,
        task="small",
        classes=("a", "b", "c"),
        image_shape=(2, 2),
        optics=Shown(levels, patterns, exposure_us * 1e-6 * top_hz / (levels - 1)),
        automaton=automaton,
        provenance={"seed": 2},
    )
    conditions = {"profile": "ideal", "task": "small", "split": "test", "objects": 10}
    figures = {"accuracy": 0.5, "clicks": 1.0, "photons": 2.0, "illumination": 3.0, "exposures": 2.0}
    return with_expected(bundle, conditions | figures)
