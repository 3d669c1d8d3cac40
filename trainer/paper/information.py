"""What readouts know of the label, against photons: frames beside click words (paper, Fig. 2C).

Owns the levels and the page; the information is that of information.py, the posterior that of baseline_bayes.py. Both see the same
light, counted in
photoelectrons per decision. Of frames the information is bounded from below (their readouts cannot be enumerated), of click words it is a
sum. SIMULATED, ideal shot noise, no dark counts; FashionMNIST.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from pans.runtime.instrument.click_law import ClickLaw, click_probability
from pans.runtime.instrument.profile import load_profile
from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import Measurement, detect, measure
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.evaluate.information import fisher, fisher_of_frames, posterior_information, word_information
from pans.trainer.tasks.registry import Objects, Task, load_task

from . import figures_light
from .page import Asked
from .sweeps import shipped_bundle

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5)
POSTERIOR_MAX = 1e3  # beyond it the mixture of the training objects is a nearest neighbour and knows nothing new
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel
FRAMES = 1000  # test objects whose frames are read out
FISHER_OBJECTS = 6000
PAPER = "falls below 10^4 to 10^5 photons"


def information_table(asked: Asked) -> dict[str, Any]:
    """Return one row per way and photon level, and the Markdown."""
    bundle = shipped_bundle()
    task = load_task(bundle.task, asked.data_dir)
    test = Objects(task.test.images[:FRAMES], task.test.labels[:FRAMES])
    rows = _frames(replace(task, test=test), asked.report) + _words(task, asked.report)
    pictures = {"": partial(figures_light.information, rows=rows)}
    return {"rows": rows, "markdown": markdown(rows, bundle.name), "pictures": pictures}


def _frames(task: Task, report: Callable[[str], None]) -> list[dict[str, Any]]:
    measurement = measure(task, None)
    light = measurement.photoelectrons(measurement.train[:FISHER_OBJECTS], 1.0).astype(np.float64)
    ratios = fisher_of_frames(light, measurement.train_labels[:FISHER_OBJECTS], PHOTONS)
    rows = []
    for photons, ratio in zip(PHOTONS, ratios):
        row: dict[str, Any] = {"way": "frames", "photons": photons, "fisher": asdict(ratio), "objects": FRAMES}
        if photons <= POSTERIOR_MAX:
            row |= _posterior(measurement, photons)
        report(f"frames, {photons:g} photons: {row.get('bits', float('nan')):.2f} bits, trace ratio {ratio.trace:.4f}")
        rows.append(row)
    return rows


def _posterior(measurement: Measurement, photons: float) -> dict[str, Any]:
    readouts = detect(measurement.photoelectrons(measurement.test, photons), "counting", np.random.default_rng([0, 4]))
    joint = log_joint(measurement, readouts, photons, "counting", floor=FLOOR)
    known = posterior_information(joint, measurement.test_labels)
    right = joint.argmax(axis=1) == measurement.test_labels
    return {
        "bits": known.lower_bits,
        "bits_se": known.lower_bits_se,
        "believed_bits": known.believed_bits,
        "accuracy": float(right.mean()),
        "clicks": float((readouts > 0).sum(axis=1).mean()),
    }


def _words(task: Task, report: Callable[[str], None]) -> list[dict[str, Any]]:
    """The shipped patterns with all light scaled, behind a detector without dark counts or read noise."""
    bundle, law, n_classes = shipped_bundle(), ClickLaw(), len(task.classes)
    profile = load_profile(str(bundle.provenance["profile"]))
    train, test = (light_of(bundle, profile, part.images).photoelectrons for part in (task.train, task.test))
    given = float(test.sum(axis=1).mean())
    rows = []
    for photons in PHOTONS:
        eta = photons / given
        known = word_information(eta * train, task.train.labels, eta * test, task.test.labels, n_classes, law=law)
        p = click_probability(law, eta * test)
        ratio = fisher(p, p * (1 - p), task.test.labels)
        row = {"way": "click words", "photons": photons, "bits": known.heldout_bits, "bits_se": 0.0}
        row |= {"accuracy": known.heldout_bayes_accuracy, "clicks": known.clicks, "fisher": asdict(ratio)}
        report(f"click words, {photons:g} photons: {known.heldout_bits:.2f} bits")
        rows.append(row | {"objects": len(test), "illumination": bundle.illumination() * eta})
    return rows


def markdown(rows: list[dict[str, Any]], bundle: str) -> str:
    """Return the page."""
    lines = [
        "# Information against photons (paper, Fig. 2C)",
        "",
        "SIMULATED, FashionMNIST, ideal shot noise. Command: `pans reproduce fig-2c` (seed 0). Frames: 784 perfect photon "
        "counters, the posterior over all "
        f"60 000 training objects (floor {FLOOR:g}), {FRAMES} test images (the first ones); Fisher's ratios of {FISHER_OBJECTS} "
        "training objects. "
        "Click words: the ten patterns of "
        f"`{bundle}`, all light scaled to the photons of the row (the modulator's imperfect black included), all 10 000 test "
        "images, posterior table of the training objects. "
        "Bits of 3.32. Neither way has a spread over trials: frames are read out once (error from the objects: 0.03 bits at "
        "most), click words enumerated.",
        "",
        "| way | photons | clicks | bits of the label, at least | error | accuracy % | tr(S_b)/tr(S_w) | tr(S_w^-1 S_b) |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_line(row) for row in rows),
        "",
        *_says(rows),
        "",
    ]
    return "\n".join(lines)


def _line(row: dict[str, Any]) -> str:
    def shown(key: str, digits: int, factor: float = 1.0) -> str:
        return f"{factor * row[key]:.{digits}f}" if key in row else "-"

    ratio = row["fisher"]
    discriminant = "-" if ratio["discriminant"] is None else f"{ratio['discriminant']:.2f}"
    return (
        f"| {row['way']} | {row['photons']:g} | {shown('clicks', 2)} | {shown('bits', 2)} | {shown('bits_se', 3)} "
        f"| {shown('accuracy', 1, 100)} | {ratio['trace']:.4f} | {discriminant} |"
    )


def _says(rows: list[dict[str, Any]]) -> list[str]:
    frames = {row["photons"]: row for row in rows if row["way"] == "frames"}
    words = {row["photons"]: row for row in rows if row["way"] == "click words"}
    known = {photons: row["bits"] for photons, row in frames.items() if "bits" in row}
    few, many = known[30.0], known[max(known)]
    above = [photons for photons in known if words[photons]["bits"] > known[photons]]
    return [
        f"- The paper says that information and Fisher ratio {PAPER.replace('falls', 'fall')}. The trace ratio does: it adds up "
        "the shot noise of all pixels. The "
        f"information does not: {100 * few / many:.0f} % of what is proven at {max(known):g} photons is there at 30.",
        "- The ten patterns know more of the label than the frame at "
        + (", ".join(f"{photons:g}" for photons in above) or "none of the levels")
        + " photons; at many photons the frame knows more.",
    ]
