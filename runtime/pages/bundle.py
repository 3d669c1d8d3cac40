"""The pages of a bundle and of what was measured (calibration, registration), and the pictures of patterns or optics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.outputs import write_file
from pans.runtime.registration.estimate import Estimate, pattern_residuals
from pans.runtime.registration.file import registration_values
from pans.runtime.registration.measure import Registration
from pans.runtime.registration.parameters import DARK, N_GEOMETRY, PARAMETERS, flat_basis
from pans.runtime.report.file_facts import file_facts

from .charts import Axis, Bars, Curve, Mark, chart, percent, whole
from .page import picture, render
from .rates import Rates

PATTERNS_MAX, STATES_SHOWN = 48, 24
FAR = 5.0  # standard errors at the ends of the residuals' axis
F64 = NDArray[np.float64]


def bundle_page(path: Path) -> bytes:
    """Return the page of a bundle: what it is, its patterns, optics or automaton, where it comes from."""
    bundle, sha256 = load_bundle(path)
    facts = file_facts(path)
    provenance = {"SHA-256": sha256, **facts.pop("provenance", {})}
    walks = None if bundle.automaton is None else _automaton(bundle, bundle.automaton)
    shown = optics(bundle) if walks is None else None
    return render("bundle.html", bundle=bundle, facts=facts, provenance=provenance, optics=shown, automaton=walks)


def optics(bundle: Bundle, rates: Rates | None = None) -> dict[str, Any]:
    """Return the fixed patterns, or the rows of passive optics, as pictures with lines; with a run's `rates` what a click on each means."""
    if bundle.analyser is None:
        values, unit = (
            bundle.patterns().reshape(-1, *bundle.image_shape),
            "photoelectrons per exposure and unit transmission",
        )
    else:
        values = np.abs(bundle.analyser.matrix).astype(np.float64).reshape(-1, *bundle.image_shape)
        unit = "modulus of W"
    pictures = []
    for number, value in enumerate(values[:PATTERNS_MAX]):
        lines = [] if rates is None else rates.meaning(number, bundle.classes)
        if bundle.analyser is None:
            lines.append(f"light {value.sum():.4g}, brightest pixel {value.max():.3g}")
        pictures.append((f"{'pattern' if bundle.analyser is None else 'row'} {number}", picture(value), lines))
    return {"pictures": pictures, "n": len(values), "unit": unit, "bundle": bundle, "measured": rates is not None}


def _automaton(bundle: Bundle, automaton: Automaton) -> dict[str, Any]:
    """What the first states show and what a click there means, how many states each step has, and how sure they are."""
    pictures = []
    for state in range(min(STATES_SHOWN, automaton.n_states)):
        lines = [f"{what}: {words}" for what, words in outcomes(automaton, state, bundle.classes).items()]
        lines.insert(0, f"step {int(automaton.depth[state]) + 1}")
        pictures.append((f"state {state}", picture(state_picture(bundle, automaton, state)), lines))
    sure = automaton.posteriors.max(axis=1)
    steps = [sure[: automaton.n_states][automaton.depth == slot] for slot in range(automaton.n_slots)]
    x, counts = Axis("step of the walk", 0.5, len(steps) + 0.5, text=whole), [len(values) for values in steps]
    bars = [Bars(np.arange(len(steps) + 1) + 0.5, counts)]
    low, middle, high = np.array([np.quantile(values, (0.25, 0.5, 0.75)) for values in steps]).T
    curve = Curve(np.arange(1, len(steps) + 1), middle, low=low, high=high)
    y = Axis("largest probability", 0.0, 1.0, text=percent)
    return {
        "pictures": pictures,
        "states": chart(
            "Number of states in each step", x, Axis("states", 0.0, 1.05 * max(counts)), bars=bars, height=190
        ),
        "sure": chart("Largest probability of a class in the states of each step", x, y, curves=[curve], height=190),
        "leaves": float(np.median(sure[automaton.n_states :])),
    }


def state_picture(bundle: Bundle, automaton: Automaton, state: int) -> F64:
    """Return what a state shows, in levels, float64 (height, width); of several channels their patterns side by side, a line between."""
    parts = bundle.pattern_levels[automaton.rows[state]].astype(np.float64).reshape(-1, *bundle.image_shape)
    line = np.full((bundle.image_shape[0], 1), parts.max())
    return np.concatenate([piece for part in parts for piece in (line, part)][1:], axis=1)


def outcomes(automaton: Automaton, state: int, classes: tuple[str, ...]) -> dict[str, str]:
    """Return outcome -> the most probable class after it in `state`, the one with most clicks first."""
    if automaton.counts:
        last = automaton.n_outcomes - 1
        names = [*(f"{number} photons" for number in range(last)), f"{last} photons or more"]
    elif automaton.channels > 1:
        names = [clicked_words(word, automaton.channels) for word in range(automaton.n_outcomes)]
    else:
        names = ["no click", "click"]
    found = {}
    for outcome in reversed(range(len(names))):
        after = automaton.posteriors[int(automaton.successors[state, outcome])]
        found[names[outcome]] = f"{classes[int(after.argmax())]} {100 * float(after.max()):.0f} %"
    return found


def clicked_words(word: int, channels: int) -> str:
    """Return which channels clicked in an outcome, in words.

    >>> clicked_words(0, 2), clicked_words(2, 2), clicked_words(3, 2)
    ('no click', 'click on 1', 'clicks on 0, 1')
    """
    clicked = [str(channel) for channel in range(channels) if word >> channel & 1]
    return f"click{'s' * (len(clicked) > 1)} on {', '.join(clicked)}" if clicked else "no click"


# ---- what was measured ----


def measured_page(path: Path) -> bytes:
    """Return the page of a calibration or a registration."""
    facts = file_facts(path)
    parameters, channels = facts.pop("parameters", {}), facts.pop("channels", None) or []
    return render(
        "measured.html", facts=facts, parameters=_parameters(parameters), channels=channels, pictures=[], charts=[]
    )


def _parameters(found: dict[str, Any]) -> list[tuple[str, dict[str, float], str]]:
    units = {one.name: one.unit for one in PARAMETERS}
    return [(name, row, units.get(name, "")) for name, row in found.items()]


def write_registration_page(
    path: Path, measurement: Registration, found: Estimate, *, simulated: bool, force: bool = False
) -> None:
    """Write the page of a registration with the target, the light of all patterns and what the model leaves; UsageError as `write_file`."""
    assert measurement.observed is not None
    bench = measurement.bench
    facts = registration_values(found, bench.shape) | {"kind": "registration", "device": {"simulated": simulated}}
    stated, seen = bench.target.reshape(bench.shape), bench.appearance(found.values[:N_GEOMETRY]).reshape(bench.shape)
    field = (1.0 + found.values[7:DARK] @ flat_basis(bench.shape)).reshape(bench.shape)
    pictures = [
        ("as stated", picture(stated, high=1.0), ["on the pattern grid"]),
        ("as seen", picture(seen, high=1.0), ["moved, turned, blurred"]),
        ("seen - stated", picture(seen - stated, -1.0, 1.0), ["black to white: -1 to 1"]),
        (
            "flat field",
            picture(field, float(field.min()), float(field.max())),
            [f"{field.min():.3f} to {field.max():.3f}"],
        ),
    ]
    expected, share, deviation = pattern_residuals(bench, measurement.observed, found.values)
    top = float(max(expected.max(), share.max(), 1e-3))
    curves = [Curve(expected, share, "patterns", dots=True), Curve([0.0, top], [0.0, top], "equal", "b")]
    x, y = Axis("expected share of clicks", 0.0, top), Axis("measured share of clicks", 0.0, top)
    words = "share of exposures that clicked against the share that the model expects, a dot for each pattern"
    agreement = chart(words, x, y, curves=curves)
    dots = Curve(np.arange(len(deviation)), np.clip(deviation, -FAR, FAR), dots=True)
    x, y = (
        Axis("pattern", 0.0, float(max(len(deviation) - 1, 1)), text=whole),
        Axis("residual (standard errors)", -FAR, FAR),
    )
    marks = [Mark(2.0, "+2"), Mark(-2.0, "-2")]
    left = chart("residual of every pattern in standard errors", x, y, curves=[dots], marks=marks)
    rows = _parameters(facts.pop("parameters"))
    charts = [
        (agreement, "Every pattern's share of clicks."),
        (left, "Measured less expected clicks over their standard error."),
    ]
    page = render("measured.html", facts=facts, parameters=rows, channels=[], pictures=pictures, charts=charts)
    write_file(path, page, force=force)
