"""What can be asked of a training, a baseline and an evaluation: dataclasses whose fields are options of the command line.

`check_options` returns nothing, or raises with the numbers, for what cannot be trained on a profile; of automata
train/automaton/budget.py does.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import MISSING, asdict, dataclass
from typing import Any

from pans.base.console import add_options, option, option_fields
from pans.base.console import check_options as check_ranges
from pans.base.errors import PlanError, UsageError, as_usage_error
from pans.base.numbers import Range
from pans.bundle.automaton import CHANNELS_MAX, CONFIDENCE_RANGE, SLOTS_MAX, STATES_MAX
from pans.instrument.click_law import OUTCOMES_MAX, cannot_count
from pans.instrument.optics import NO_BLEACHING, Bleaching, Imaging, Tolerance, bleaching_of, tolerance_of
from pans.instrument.profile import Profile

EXACT_FEATURES_MAX = 12  # 4096 click words per object
EXACT_WORDS_MAX = 1 << EXACT_FEATURES_MAX
STRAIGHT_THROUGH = ("ste", "identity")  # from the first epoch to the last
ESTIMATOR_NAMES = (*STRAIGHT_THROUGH, "exact", "local", "disarm", "loo")  # estimators.py
COUNTED_ESTIMATORS = ("ste", "exact", "local")  # those that know photon numbers
ENCODERS = ("active", "coherent", "incoherent")
PICTURE_HEADS = ("picture", "decoder")  # heads.py
HEADS = ("mlp", "deep", "conv", *PICTURE_HEADS)
# (gain on the relative excess, least weight). Firm: the full rate from an excess of 20 % on, and a weight never so small that it
# would not be back in time; it meets tight budgets. Gentle: the light is spent first and given back late, which found better patterns.
BUDGETS = {"firm": (5.0, 3e-4), "gentle": (1.0, 1e-5)}
LEAST_PHOTONS = 0.01  # per decision: below, nothing can be compared
DEFAULT_ALPHA = 3e-4  # weight of the illumination that costs little accuracy on the public sets
METHODS = {  # of each paradigm of `pans baseline`, the default first
    "direct": ("bayes", "cnn", "clean-cnn", "stopping"),
    "compressive": ("mlp", "clean-mlp", "bayes"),
    "e2e": ("qat", "plain"),
    "fsi": ("deep", "pca", "stopping"),
    "hadamard": ("differences", "counts"),
}

LIGHT = Range(1e-9, 1e9)  # photoelectrons or clicks: beyond, nothing can be drawn or trained
NONE_OR_LIGHT = Range(0, 1e9)
BUDGET = Range(0.1, 1000)  # of an automaton
SHARE = Range(0, 1)
TENFOLD = Range(0, 10)
SEED = Range(0, (1 << 63) - 1, whole=True)
EPOCHS = Range(1, 100_000, whole=True)
THOUSAND = Range(1, 1000, whole=True)
UP_TO_THOUSAND = Range(0, 1000, whole=True)
PIXELS = Range(0, 65536, whole=True)
BATCH = Range(2, 1 << 20, whole=True)
OUTCOMES = Range(2, OUTCOMES_MAX, whole=True)
PATTERNS = Range(1, 4096, whole=True)
FIELDS = Range(0, 1024, whole=True)  # per class: as many as the binned pixels of model/field_basis.py


@dataclass(frozen=True, slots=True)
class Options:
    """What to train. `alpha` weighs the illumination; `photons`, `clicks` and `illumination` are targets per inference, held by weights."""

    features: int = option(MISSING, "number of patterns (not of an automaton)", range=PATTERNS)
    alpha: float | None = option(None, "weight of the illumination in the loss (default 0.0003)", range=NONE_OR_LIGHT)
    photons: float | None = option(None, "photoelectrons per decision to aim for", range=LIGHT)
    clicks: float | None = option(None, "clicks per decision to aim for, beside either", range=LIGHT)
    estimator: str = option(
        "exact", "default: exact up to 12 patterns, else local; of pictures ste", choices=ESTIMATOR_NAMES
    )
    epochs: int = option(60, "passes over the training objects (default 60; of an automaton 6)", range=EPOCHS)
    seed: int = option(0, "of everything random (default 0)", range=SEED)
    restarts: int = option(1, "trainings; the best on validation stays", range=THOUSAND)
    starts: int = option(1, "runs of the first stage per restart; the best is trained to the end", range=THOUSAND)
    warm: float = option(0.3, "part of the epochs in the first stage, if another follows", range=SHARE)
    head: str = option("mlp", "digital back end (default mlp; picture where the task asks for it)", choices=HEADS)
    hidden: int = option(512, "hidden units of the head (default 512)", range=Range(1, 65536, whole=True))
    batch: int = option(512, "objects per step (default 512; of an automaton 250)", range=BATCH)
    front_rate: float = option(1e-2, "learning rate of patterns or W, at its peak (default 0.01)", range=SHARE)
    head_rate: float = option(1e-3, "learning rate of the head, at its peak (default 0.001)", range=SHARE)
    constant: bool = False  # learning rates as in the paper, instead of one cycle per estimator
    # of the light at the start; rises or falls to 1 within stage 1
    slope: float = option(1.0, "slope annealing: light at the start times N", range=Range(1e-9, 1e6))
    clamp: float = option(math.inf, "clamp photoelectrons early in training", range=LIGHT)
    similarity: float = option(
        0.0, "of pictures: share of 1 - SSIM in the loss, the rest being the squared error (default 0)", range=SHARE
    )
    polish: float = option(0.0, "last part of the epochs, trained for decisions (default 0)", range=SHARE)
    encoder: str = "active"
    complex_field: bool = option(False, "a coherent encoder's W is complex, not real")
    conserving: bool = option(False, "a passive encoder gives no more light than it gets (default)")
    input_photons: float | None = option(
        None, "mean photoelectrons that reach a passive encoder in one exposure", range=LIGHT
    )
    dark: float | None = option(
        None, "dark photoelectrons per exposure in training, instead of the profile's", range=NONE_OR_LIGHT
    )
    budget: str = option(
        "firm",
        "how strictly --photons, --clicks and --illumination hold during training (default firm)",
        choices=tuple(BUDGETS),
    )
    light: float = option(1.0, "light of the initial patterns or W, times the paper's (default 1)", range=LIGHT)
    mix: float = option(0.0, "share of the loss of several shots, for patterns too (default 0)", range=SHARE)
    shots: int = option(1, "fit the head to 1 to N shots (default 1)", range=Range(1, 64, whole=True))
    shift_px: int = option(0, "move training images by up to N pixels along the rows (default 0)", range=PIXELS)
    offset_px: int = option(0, "and by up to N across them (default 0)", range=PIXELS)
    copies: int = option(
        0,
        "add N distorted copies of every training image: turned, stretched, bent a little (default 0; of an automaton for mnist 20)",
        range=UP_TO_THOUSAND,
    )
    bleach: str | None = option(
        None,
        "train for objects of many emitters per pixel that bleach: 1/e of a pixel's light is left after D0 photoelectrons of illumination",
        metavar="D0[:mixed]",
    )
    optics: str | None = option(
        None,
        "train through optics drawn within this tolerance, like shift=1:rotate=2:psf=0.5..0.8:black=0.002",
        metavar="SPEC",
    )
    outcomes: int = option(
        2,
        "outcomes of an exposure; 3: no photon, one, two or more, on a detector that counts (default 2)",
        range=OUTCOMES,
    )
    spread: float = option(
        0.0,
        "weight in the loss of how concentrated the light of a pattern is, for optics that are not perfect (default 0)",
        range=TENFOLD,
    )
    illumination: float | None = option(
        None, "photoelectrons to send per decision, summed over all pixels of all patterns", range=LIGHT
    )
    fields: int = option(
        0,
        "train a coherent encoder as sums of N discriminant fields per class: for scenes with a bright background (default 0: of pixels)",
        range=FIELDS,
    )
    search: bool = option(
        False,
        "with --fields, of two classes in square scenes without an up: --restarts encoders at once, exactly over all click words",
    )


@dataclass(frozen=True, slots=True)
class AutomatonOptions:
    """What to train. `photons` or `clicks`, `illumination`, or one of each are the budget of one decision, on average; `dose_cap` is one
    of light sent that no walk passes.

    0 exposures or states stand for defaults.
    """

    photons: float | None = option(None, "photoelectrons per decision to aim for", range=BUDGET)
    clicks: float | None = option(None, "clicks per decision to aim for", range=BUDGET)
    illumination: float | None = option(None, "photoelectrons to send per decision", range=LIGHT)
    dose_cap: float | None = option(
        None,
        "photoelectrons that no walk sends more of: exposure by exposure every walk sends the same light",
        range=LIGHT,
    )
    exposures: int = option(0, "exposures per decision (default: by the budget)", range=Range(0, SLOTS_MAX, whole=True))
    states: int = option(0, "most states per exposure (default: by the budget)", range=Range(0, STATES_MAX, whole=True))
    seed: int = option(0, "of everything random", range=SEED)
    batch: int = option(250, "objects per step", range=BATCH)
    grow_epochs: int = 2
    candidates: int = 6
    first_price: float = 0.2  # nats per photoelectron detected of the first exposure, halved every `half` levels
    half: float = 6.0
    price: float = 1.0  # times the price with which a budget begins, of public sets: less where light tells less
    tune_epochs: int | None = None  # of grey patterns; None: 3, or 0 through optics, where they brought nothing
    epochs: int = option(6, "of the patterns as they are displayed", range=EPOCHS)
    tune_rate: float = 0.005
    rate: float = option(0.01, "learning rate of its last stage (default 0.01)", range=SHARE)
    reroutes: int = option(2, "sweeps that move edges to better states (default 2)", range=UP_TO_THOUSAND)
    shift_px: int = option(0, "along the rows, anew in every epoch", range=PIXELS)
    offset_px: int = option(0, "and across them", range=PIXELS)
    copies: int | None = option(
        None, "distorted copies, which the epochs take in turn (default: by the task)", range=UP_TO_THOUSAND
    )
    grey: bool = option(False, "patterns in all levels, not one bit and a brightness")
    # at full strength distortions cost more than they bring
    strength: float = option(0.3, "of the distortions, times the usual (default 0.3)", range=TENFOLD)
    # from the second epoch of the last stage on; the rest is the log loss
    decide: float = option(0.7, "part of the last loss that counts wrong decisions (default 0.7)", range=SHARE)
    exposure_price: float = option(
        0.0, "nats per exposure; walks then end early where that pays (default 0)", range=TENFOLD
    )
    patterns: int = option(
        0,
        "most different patterns, which states share (default: the projector's memory)",
        range=Range(0, 65_535, whole=True),
    )
    soft: float | None = option(
        None, "weight of a network's answers in the targets (default: 0.5 for fashion-mnist, else 0)", range=SHARE
    )
    teacher_epochs: int = 6  # of that network
    dark: float | None = option(None, "dark photoelectrons per exposure, instead of the profile's", range=NONE_OR_LIGHT)
    optics: str | None = option(None, "tolerance of the optics to train through")
    bleach: str | None = option(None, "train for objects that bleach", metavar="D0:mixed")
    spread: float = option(0.0, "weight of the concentration of the light", range=TENFOLD)
    outcomes: int = option(2, "of one exposure", range=OUTCOMES)
    channels: int = option(
        1,
        "detectors that are read at once, each with a pattern of its own (default 1, at most 4)",
        range=Range(1, CHANNELS_MAX, whole=True),
    )
    start: str | None = None  # sha256 of the bundle whose automaton is trained on, instead of one that grows

    @property
    def successors(self) -> int:
        """Number of outcomes of one exposure."""
        return 1 << self.channels if self.channels > 1 else self.outcomes


@dataclass(frozen=True, slots=True)
class BaselineOptions:
    """One way to measure and to decide. `epochs`, `trials` and `floor` at None: the default of the method."""

    paradigm: str = option(MISSING, "how the object is measured", flag="paradigm", choices=tuple(METHODS))
    method: str = option(MISSING, "; ".join(f"{k}: {', '.join(v)}" for k, v in METHODS.items()), metavar="M")
    features: int = option(32, "patterns, masks or pairs, unless direct (default 32)", range=PATTERNS)
    patterns: str = option("binary", "of compressive sensing", choices=("binary", "hadamard"))
    detector: str = option(
        "counting", "Poisson counts, or one click at most (default counting)", choices=("counting", "binary")
    )
    brightness: str = option(
        "source", "one source for all objects (default), or every object gives N photons", choices=("source", "object")
    )
    floor: float | None = option(None, "of bayes: least transmission (default: chosen)", range=Range(1e-9, 1 - 1e-9))
    dark: float = option(0.0, "dark photoelectrons per readout", range=NONE_OR_LIGHT)
    bits: int = option(4, "of qat: bits of a detected value (default 4)", range=Range(1, 16, whole=True))
    epochs: int | None = option(
        None,
        "of a network (default: 5 CNN, 10 MLP and pairs, 15 end-to-end and masks, stopping by the task)",
        range=Range(1, 10_000, whole=True),
    )
    trials: int | None = option(
        None, "readouts per object (default: bayes 2, stopping 1, others 10)", range=Range(1, 100_000, whole=True)
    )
    information: bool = option(
        False, "of bayes, on a counting detector: bits that the readouts know of the label, and Fisher's ratio"
    )
    seed: int = option(0, "of everything random (default 0)", range=SEED)


@dataclass(frozen=True, slots=True)
class Conditions:
    """How the objects are shown: by default through the profile that the bundle was trained for, as it is."""

    profile: str | None = option(None, "default: what the bundle was trained for", metavar="P")
    eta: float = option(1.0, "scale all light by E (default 1)", type=float, metavar="E")
    dark: float | None = option(
        None, "dark photoelectrons per exposure, instead of the profile's", type=float, metavar="R"
    )
    seed: int = option(0, "of the trials (default 0)", range=SEED)
    data_seed: int | None = option(None, "of a drawn task (default: that of the bundle's training)", range=SEED)
    confidence: float = option(
        0.0,
        "of an automaton: decide as soon as a class is this probable, abstain if none is at the end",
        range=CONFIDENCE_RANGE,
    )
    imaging: Imaging | None = None  # how objects stand on the grid of the patterns; None: as the profile states
    bleaching: Bleaching = NO_BLEACHING  # what the light does to the objects, each of them fresh when it comes

    def imaging_on(self, profile: Profile) -> Imaging:
        """Return how objects stand on the grid of the patterns, on `profile`."""
        return profile.imaging() if self.imaging is None else self.imaging


def option_names(kind: type[Any]) -> tuple[str, ...]:
    """Return the names of the fields of `kind` that are options."""
    return tuple(one.name for one, _ in option_fields(kind))


def add_unset_options(parser: Any, kind: type[Any], omit: Collection[str] = ()) -> None:
    """Add the options of `kind`; those that are not given stay None, so that a task or its images can choose them."""
    unset = {one.name: None for one, _ in option_fields(kind) if not isinstance(one.default, bool)}
    add_options(parser, kind, defaults=unset, omit=omit)


def flag_of(name: str) -> str:
    """Return the option that fills the field `name`."""
    return "--" + name.replace("_", "-")


def stated_tolerance(profile: Profile) -> str | None:
    """Return the tolerance that `profile` states for its optics, as `--optics` spells it; None where it states perfect ones."""
    if profile.optics is None:
        return None
    tolerance = profile.optics.tolerance()
    return None if tolerance == Tolerance() else tolerance.spelled()


def check_options(options: Options, profile: Profile) -> None:
    """Raise UsageError or PlanError for what cannot be trained on this profile."""
    check_ranges(options)
    if options.encoder not in ENCODERS:
        raise UsageError(f"--encoder is {options.encoder!r}, allowed: {', '.join(ENCODERS)}")
    _check_together(options)
    _check_fits(options, profile)


def check_optics(text: str) -> None:
    """Raise UsageError unless `text` is a tolerance of optics."""
    with as_usage_error():
        tolerance_of(text)


def _check_together(options: Options) -> None:
    """Refuse options that are right by themselves and not together."""
    active, counted = options.encoder == "active", options.outcomes > 2
    most_clicks = options.features * (options.outcomes - 1)
    most_patterns = int(math.log(EXACT_WORDS_MAX, options.outcomes) + 1e-9)
    if options.clicks is not None and options.clicks >= most_clicks:
        raise UsageError(f"--clicks is {options.clicks}, allowed: below {most_clicks}, all that the patterns can bring")
    if options.illumination is not None and not active:
        raise UsageError(f"--illumination: a {options.encoder} encoder sends no light", remedy="--input-photons N")
    if options.estimator == "exact" and options.features > most_patterns:
        raise UsageError(
            f"the exact estimator enumerates {options.outcomes}**{options.features} click words, allowed: at most "
            f"{most_patterns} patterns",
            remedy="use --estimator local",
        )
    if options.optics is not None:
        check_optics(options.optics)
        if not active:
            what = f"--optics: a {options.encoder} encoder shows no patterns that could miss the object"
            raise UsageError(what, remedy="leave it out, or use --encoder active or automaton")
    if options.bleach is not None:
        with as_usage_error():
            bleaching_of(options.bleach)
        if not active or options.optics is not None or options.shots > 1:
            what = "--bleach is for patterns that are sent once each, on perfect optics: not for a passive encoder, --optics or --shots"
            raise UsageError(what, remedy="leave --bleach out, or the other one")
    if counted and (not active or options.head in PICTURE_HEADS or options.bleach is not None):
        what = f"--outcomes {options.outcomes} is for patterns that are sent, and classes: not for a passive encoder, pictures or --bleach"
        raise UsageError(what, remedy="leave --outcomes out, or the other one")
    if counted and options.estimator not in COUNTED_ESTIMATORS:
        raise UsageError(
            f"--estimator {options.estimator} knows clicks alone, allowed with --outcomes {options.outcomes}: "
            f"{', '.join(COUNTED_ESTIMATORS)}",
            remedy="use --estimator local",
        )
    if options.mix > 0 and options.shots < 2:
        raise UsageError(f"--mix is {options.mix} with --shots {options.shots}", remedy="--shots 2, or more")
    if options.fields and (options.encoder != "coherent" or options.complex_field or options.head in PICTURE_HEADS):
        what = "--fields is for a coherent encoder with a real W, and for classes"
        raise UsageError(what, remedy="add --encoder coherent without --complex-field, or leave --fields out")
    if options.search:
        _check_search(options)


def _check_search(options: Options) -> None:
    """Refuse what train/gradient/exact_search.py does not know: it has no estimator, no stages and one budget, that of clicks."""
    if not options.fields or options.clicks is None or options.conserving:
        what = "--search is for a coherent encoder within a budget of clicks, whose W is not limited"
        raise UsageError(what, remedy="add --fields N, --clicks C and --unconstrained, or leave --search out")
    unused = Options(features=options.features)
    names = ("photons", "polish", "starts", "mix", "copies", "shift_px", "offset_px")
    others = [flag_of(name) for name in names if getattr(options, name) != getattr(unused, name)]
    if others or options.estimator != "exact":
        what = f"{(others or ['--estimator ' + options.estimator])[0]} has no effect with --search"
        raise UsageError(what, remedy=f"leave it out; --search takes at most {EXACT_FEATURES_MAX} patterns")


def check_order(order: str | None, options: Options) -> None:
    """Refuse --order where there is none, before anything is trained."""
    if order and (options.encoder != "active" or options.head != "mlp" or options.bleach):
        what = "--order is for patterns that are sent and the head mlp; trained through bleaching, they have an order already"
        raise UsageError(what, remedy="leave --order out")


def _check_fits(options: Options, profile: Profile) -> None:
    """Refuse what the detector or the projector of `profile` cannot do."""
    sequential = profile.mode == "sequential"
    why = cannot_count(profile, options.outcomes) if options.outcomes > 2 else ""
    if options.outcomes > 2 and (why or not sequential):
        raise PlanError(
            why
            or f"--outcomes {options.outcomes}: {profile.name} displays all patterns at once, photon numbers need them in turn",
            remedy="use a profile whose detector counts: --profile dmd-qcmos",
        )
    if options.bleach is not None and not sequential:
        what = f"--bleach: {profile.name} displays all patterns at once, none meets what another has left"
        raise UsageError(what, remedy="leave it out")
    channels, memory = profile.detector.channels, profile.projector.pattern_memory
    if not sequential and options.features > channels:
        what = f"{options.features} patterns at once, {profile.name} has {channels} detector channels"
        raise PlanError(what, remedy=f"--features {channels}, or fewer")
    if options.encoder == "active" and options.features > memory:
        what = f"{options.features} patterns, the pattern memory of {profile.name} holds {memory}"
        raise PlanError(what, remedy=f"--features {memory}, or fewer")


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
