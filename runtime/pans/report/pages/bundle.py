"""The pages of a bundle and of what was measured (calibration, registration), and the pictures of patterns or optics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.files import write_file
from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle, load_bundle
from pans.calibrate.registration import (
    DARK,
    N_GEOMETRY,
    PARAMETERS,
    Estimate,
    Registration,
    flat_basis,
    pattern_residuals,
    registration_values,
)
from pans.report.files.facts import file_facts

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
    if (automaton := bundle.automaton) is None:
        shown: dict[str, Any] = {"optics": optics(bundle)}
    else:
        sure = automaton.posteriors[: automaton.n_states].max(axis=1)
        steps = [np.quantile(sure[automaton.depth == slot], (0.25, 0.5, 0.75)) for slot in range(automaton.n_slots)]
        shown = {"states": first_states(bundle, automaton), "sure": np.array(steps).T}
    return render("bundle.html", bundle=bundle, facts=facts, provenance=provenance, **shown)


def optics(bundle: Bundle, rates: Rates | None = None) -> dict[str, Any]:
    """Return the fixed patterns, or the rows of passive optics, as pictures with lines; with a run's `rates` what a click on each means."""
    what, unit = "pattern", "photoelectrons per exposure and unit transmission"
    values = bundle.patterns() if bundle.analyser is None else np.abs(bundle.analyser.matrix).astype(np.float64)
    if bundle.analyser is not None:
        what, unit = "row", "modulus of W"
    found = values.reshape(-1, *bundle.image_shape)[:PATTERNS_MAX]
    pictures = [(f"{what} {number}", picture(value), value) for number, value in enumerate(found)]
    return {"pictures": pictures, "n": len(values), "unit": unit, "bundle": bundle, "rates": rates}


def first_states(bundle: Bundle, automaton: Automaton, rates: Rates | None = None) -> list[tuple[str, str, list[str]]]:
    """Return what the first states show, as pictures with lines: the next state and the most probable class after each outcome.

    With a run's `rates` also which share of its walks came to a state, and how often it clicked.
    """
    pictures = []
    for state in range(min(STATES_SHOWN, automaton.n_states)):
        lines = [] if rates is None else [rates.of_state(state)]
        lines += [f"{what}: {words}" for what, words in outcomes(automaton, state, bundle.classes).items()]
        name = f"state {state}, step {int(automaton.depth[state]) + 1}"
        pictures.append((name, picture(state_picture(bundle, automaton, state)), lines))
    return pictures


def state_picture(bundle: Bundle, automaton: Automaton, state: int) -> F64:
    """Return what a state shows, in levels, float64 (height, width); of several channels their patterns side by side, a line between."""
    parts = bundle.pattern_levels[automaton.rows[state]].astype(np.float64).reshape(-1, *bundle.image_shape)
    line = np.full((bundle.image_shape[0], 1), parts.max())
    return np.concatenate([piece for part in parts for piece in (line, part)][1:], axis=1)


def outcomes(automaton: Automaton, state: int, classes: tuple[str, ...]) -> dict[str, str]:
    """Return outcome -> the next state and the most probable class after it in `state`, the one with most clicks first."""
    if automaton.counts:
        last = automaton.n_outcomes - 1
        names = [*(f"{number} photons" for number in range(last)), f"{last} photons or more"]
    elif automaton.channels > 1:
        names = [clicked_words(word, automaton.channels) for word in range(automaton.n_outcomes)]
    else:
        names = ["no click", "click"]
    found = {}
    for outcome in reversed(range(len(names))):
        to = int(automaton.successors[state, outcome])
        after, where = automaton.posteriors[to], f"state {to}" if to < automaton.n_states else "the end"
        found[names[outcome]] = f"{where}, {classes[int(after.argmax())]} {100 * float(after.max()):.0f} %"
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
    return _measured(file_facts(path), [], None)


def _measured(facts: dict[str, Any], pictures: list[Any], left: dict[str, Any] | None) -> bytes:
    units = {one.name: one.unit for one in PARAMETERS}
    rows = [(name, row, units.get(name, "")) for name, row in facts.pop("parameters", {}).items()]
    more = {"channels": facts.pop("channels", None) or [], "pictures": pictures, "left": left}
    return render("measured.html", facts=facts, parameters=rows, **more)


def write_registration_page(
    path: Path, measurement: Registration, found: Estimate, *, simulated: bool, force: bool = False
) -> None:
    """Write the page of a registration with the target, the light of all patterns and what the model leaves; UsageError as `write_file`."""
    assert measurement.observed is not None
    bench = measurement.bench
    facts = registration_values(found, bench.shape) | {"kind": "registration", "device": {"simulated": simulated}}
    stated, seen = bench.target.reshape(bench.shape), bench.appearance(found.values[:N_GEOMETRY]).reshape(bench.shape)
    field = (1.0 + found.values[7:DARK] @ flat_basis(bench.shape)).reshape(bench.shape)
    ends = float(field.min()), float(field.max())
    pictures = [
        ("as stated", picture(stated, high=1.0), ["on the pattern grid"]),
        ("as seen", picture(seen, high=1.0), ["moved, turned, blurred"]),
        ("seen - stated", picture(seen - stated, -1.0, 1.0), ["black to white: -1 to 1"]),
        ("flat field", picture(field, *ends), ["{:.3f} to {:.3f}".format(*ends)]),
    ]
    expected, share, deviation = pattern_residuals(bench, measurement.observed, found.values)
    left = {"expected": expected, "share": share, "deviation": np.clip(deviation, -FAR, FAR), "far": FAR}
    write_file(path, _measured(facts, pictures, left), force=force)
