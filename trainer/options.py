"""What to train: the options of `pans train`, and what of them is impossible on a profile.

Owns the names, defaults and limits; never trains. `check_options` returns nothing, or raises with the numbers.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from pans.runtime.errors import PlanError, UsageError, as_usage_error
from pans.runtime.imaging import bleaching_of, tolerance_of
from pans.runtime.instrument.click_law import OUTCOMES_MAX, cannot_count
from pans.runtime.instrument.profile import Profile

EXACT_FEATURES_MAX = 12  # 4096 click words per object
EXACT_WORDS_MAX = 1 << EXACT_FEATURES_MAX
STRAIGHT_THROUGH = ("ste", "identity")  # from the first epoch to the last
ESTIMATOR_NAMES = (*STRAIGHT_THROUGH, "exact", "local", "disarm", "loo")  # estimators.py
ENCODERS = ("active", "coherent", "incoherent")
PICTURE_HEADS = ("picture", "decoder")  # heads.py
HEADS = ("mlp", "deep", "conv", *PICTURE_HEADS)
# (gain on the relative excess, least weight). Firm: the full rate from an excess of 20 % on, and a weight never so small that it
# would not be back in time; it meets tight budgets. Gentle: the light is spent first and given back late, which found better patterns.
BUDGETS = {"firm": (5.0, 3e-4), "gentle": (1.0, 1e-5)}
DEFAULT_ALPHA = 3e-4  # weight of the illumination that costs little accuracy on the public sets


@dataclass(frozen=True, slots=True)
class Options:
    """What to train. `alpha` weighs the illumination; `photons`, `clicks` and `illumination` are targets per inference, held by weights."""

    features: int
    alpha: float | None = None
    photons: float | None = None
    clicks: float | None = None
    estimator: str = "exact"
    epochs: int = 60
    seed: int = 0
    restarts: int = 1
    starts: int = 1  # runs of stage 1 per restart; the best on validation goes on
    warm: float = 0.3  # part of the epochs that stage 1 takes, when another estimator follows it
    head: str = "mlp"
    hidden: int = 512
    batch: int = 512
    front_rate: float = 1e-2
    head_rate: float = 1e-3
    constant: bool = False  # learning rates as in the paper, instead of one cycle per estimator
    slope: float = 1.0  # of the light at the start; rises or falls to 1 within stage 1 (paper: slope annealing)
    clamp: float = math.inf  # most photoelectrons per exposure in stage 1 (paper: intensity clamping)
    similarity: float = 0.0  # share of 1 - SSIM in the loss of pictures; the rest is the squared error
    polish: float = 0.0  # last part of the epochs, in which the loss turns from cross-entropy to wrong decisions
    encoder: str = "active"
    complex_field: bool = False  # of a coherent encoder: W complex; the paper's is real
    conserving: bool = False  # of a passive encoder: no more light out than in; the paper's W is unconstrained
    input_photons: float | None = (
        None  # of passive sensing: mean photoelectrons that reach the encoder; None: full scale is 1
    )
    dark: float | None = None  # dark photoelectrons per exposure in training, instead of the profile's
    budget: str = "firm"  # how fast the weight of a budget follows its excess: a key of BUDGETS
    light: float = 1.0  # of the initial patterns, times the paper's
    mix: float = 0.0  # share of the loss that several shots have in stage 2, for patterns that gain from them
    shots: int = 1  # the head is fitted to the mean clicks of 1, 2, 3, 5, ... up to that many shots
    shift_px: int = 0  # training images are moved by up to that much along the rows, for objects in flow
    offset_px: int = 0  # and across them
    copies: int = 0  # distorted copies of every training image, beside itself (distort.py)
    bleach: str | None = None  # what the patterns do to the objects, as `--bleach` spells it
    optics: str | None = None  # tolerance of the optics to train through, as `--optics` spells it
    outcomes: int = 2  # of an exposure; 3: no photon, one, two or more, on a detector that counts
    spread: float = 0.0  # weight in the loss of how concentrated the light of a pattern is (concentration.py)
    illumination: float | None = None  # of patterns that are sent: sum of their intensities


SLOPE_MAX = 1e6  # times the light that is meant: far beyond what annealing needs
LIGHT_MAX = 1e9  # photoelectrons, clicks or weights: beyond, nothing can be drawn or trained
LIMITS = {
    "features": (1, 4096),
    "epochs": (1, 100_000),
    "restarts": (1, 1000),
    "starts": (1, 1000),
    "hidden": (1, 65536),
    "batch": (2, 1 << 20),
    "seed": (0, 2**63 - 1),
    "shots": (1, 64),
    "warm": (0, 1),
    "polish": (0, 1),
    "spread": (0, 10),
    "similarity": (0, 1),
    "mix": (0, 1),
    "shift_px": (0, 65536),
    "offset_px": (0, 65536),
    "copies": (0, 1000),
    "outcomes": (2, OUTCOMES_MAX),
}
COUNTED_ESTIMATORS = ("ste", "exact", "local")  # readings.py
CHOICES = {"budget": BUDGETS, "encoder": ENCODERS, "head": HEADS, "estimator": ESTIMATOR_NAMES}


def check_options(options: Options, profile: Profile) -> None:
    """Raise UsageError or PlanError for what cannot be trained on this profile."""
    for name, (low, high) in LIMITS.items():
        if not low <= getattr(options, name) <= high:
            raise UsageError(f"{_flag(name)} is {getattr(options, name)}, allowed: {low} to {high}")
    for name, allowed in CHOICES.items():
        if getattr(options, name) not in allowed:
            raise UsageError(f"{_flag(name)} is {getattr(options, name)!r}, allowed: {', '.join(allowed)}")
    for name in ("alpha", "photons", "clicks", "illumination", "light", "input_photons"):
        value = getattr(options, name)
        if value is not None and not (value <= LIGHT_MAX and (value > 0 or (name == "alpha" and value == 0))):
            raise UsageError(f"{_flag(name)} is {value:g}, allowed: above 0, at most {LIGHT_MAX:g}")
    if not 0 < options.slope <= SLOPE_MAX or not (0 < options.clamp <= LIGHT_MAX or options.clamp == math.inf):
        raise UsageError(
            f"--slope is {options.slope:g}, --clamp is {options.clamp:g}, allowed: above 0 (slope to {SLOPE_MAX:g})"
        )
    if options.dark is not None and not 0 <= options.dark <= LIGHT_MAX:
        raise UsageError(f"--dark is {options.dark:g}, allowed: 0 to {LIGHT_MAX:g}")
    _check_together(options)
    _check_fits(options, profile)


def check_optics(text: str) -> None:
    """Raise UsageError unless `text` is a tolerance of optics."""
    with as_usage_error():
        tolerance_of(text)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _check_together(options: Options) -> None:
    """Options that are right by themselves and not beside each other."""
    if options.clicks is not None and options.clicks >= options.features * (options.outcomes - 1):
        raise UsageError(
            f"--clicks is {options.clicks}, allowed: below {options.features * (options.outcomes - 1)}, "
            f"{'one click' if options.outcomes == 2 else f'{options.outcomes - 1} photons'} per pattern at most"
        )
    if options.illumination is not None and options.encoder != "active":
        raise UsageError(f"--illumination: a {options.encoder} encoder sends no light", remedy="--input-photons N")
    most = int(math.log(EXACT_WORDS_MAX, options.outcomes) + 1e-9)
    if options.estimator == "exact" and options.features > most:
        raise UsageError(
            f"the exact estimator enumerates {options.outcomes}**{options.features} click words, allowed: at most {most} patterns",
            remedy="use --estimator local",
        )
    if options.optics is not None:
        check_optics(options.optics)
        if options.encoder != "active":
            raise UsageError(
                f"--optics: a {options.encoder} encoder shows no patterns that could miss the object",
                remedy="leave it out, or use --encoder active or automaton",
            )
    if options.bleach is not None:
        _check_bleach(options)
    if options.outcomes > 2:
        _check_counted(options)
    if options.mix > 0 and options.shots < 2:
        raise UsageError(f"--mix is {options.mix} with --shots {options.shots}", remedy="--shots 2, or more")


def _check_counted(options: Options) -> None:
    """What photon numbers of fixed patterns do not go with."""
    if options.encoder != "active" or options.head in PICTURE_HEADS or options.bleach is not None:
        raise UsageError(
            f"--outcomes {options.outcomes} is for patterns that are shown and classes: not for a passive encoder, pictures or --bleach",
            remedy="leave --outcomes out, or the other one",
        )
    if options.estimator not in COUNTED_ESTIMATORS:
        raise UsageError(
            f"--estimator {options.estimator} knows clicks alone, allowed with --outcomes {options.outcomes}: "
            f"{', '.join(COUNTED_ESTIMATORS)}",
            remedy="use --estimator local",
        )


def _check_bleach(options: Options) -> None:
    with as_usage_error():
        bleaching_of(options.bleach or "")
    if options.encoder != "active" or options.optics is not None or options.shots > 1:
        raise UsageError(
            "--bleach is for patterns that are sent once each, on perfect optics: not for a passive encoder, --optics or --shots",
            remedy="leave --bleach out, or the other one",
        )


def check_order(order: str | None, options: Options) -> None:
    """Refuse --order where there is none, before anything is trained."""
    if order and (options.encoder != "active" or options.head != "mlp" or options.bleach):
        raise UsageError(
            "--order is for patterns that are sent and the head mlp; trained through bleaching, they have an order already",
            remedy="leave --order out",
        )


def _check_fits(options: Options, profile: Profile) -> None:
    channels = profile.detector.channels
    if options.outcomes > 2:
        why = cannot_count(profile, options.outcomes)
        if why or profile.mode != "sequential":
            raise PlanError(
                why
                or f"--outcomes {options.outcomes}: {profile.name} shows all patterns at once, which no photon numbers are told of",
                remedy="use a profile whose detector counts: --profile dmd-qcmos",
            )
    if profile.mode == "parallel" and options.features > channels:
        raise PlanError(
            f"{options.features} patterns at once, {profile.name} has {channels} detector channels",
            remedy=f"--features {channels}, or fewer",
        )
    if options.bleach is not None and profile.mode != "sequential":
        raise UsageError(
            f"--bleach: {profile.name} shows all patterns at once, none meets what another has left",
            remedy="leave it out",
        )
    if options.encoder == "active" and options.features > profile.projector.pattern_memory:
        raise PlanError(
            f"{options.features} patterns, the pattern memory of {profile.name} holds {profile.projector.pattern_memory}",
            remedy=f"--features {profile.projector.pattern_memory}, or fewer",
        )


def plain_options(options: Options) -> dict[str, Any]:
    """Return the options as JSON can hold them."""
    return {key: str(value) if value == math.inf else value for key, value in asdict(options).items()}


def same_options(found: dict[str, Any], options: Options) -> bool:
    """Return whether `found` (of `plain_options`, perhaps of an earlier version) means `options`: new ones at their defaults."""
    return plain_options(Options(features=options.features)) | found == plain_options(options)


def differing_options(options: Options) -> dict[str, Any]:
    """Return what the options are besides the plain ones of as many patterns: finished parts kept by it outlive options that come later."""
    plain = plain_options(Options(features=options.features))
    return {key: value for key, value in plain_options(options).items() if key == "features" or value != plain[key]}
