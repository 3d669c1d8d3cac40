"""`pans bench sim`: what a simulated click costs, and what each further effect adds; what dark pixels save in the optics.

Owns the rows; the bits are checked against detector.py in the same run, so that no speed stands without its error. SIMULATED, all of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pans.firmware_sim.scene.detector import sample_clicks
from pans.firmware_sim.scene.detector_kernels import sample_words
from pans.firmware_sim.scene.detector_model import DetectorModel, first_click_probability
from pans.firmware_sim.scene.optics import expected_photoelectrons, photons_per_level
from pans.firmware_sim.scene.still import scene_from_arrays
from pans.runtime.bench.rows import BenchOptions, Row, cpu_time
from pans.runtime.bundle.model import load_bundle
from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.dead_time import DeadTime
from pans.runtime.instrument.profile import load_profile

from .bench_flow import flow_rows

CHANNELS, OBJECTS, EXPOSURES, CHECKED = 10, 200, 200_000, 20_000
PLAIN = DetectorModel(ClickLaw())
EFFECTS: dict[str, DetectorModel] = {
    "plain thresholded Poisson": PLAIN,
    "+ dark counts": replace(PLAIN, law=ClickLaw(dark_per_exposure=0.01)),
    "+ read noise and threshold (qCMOS)": replace(PLAIN, law=ClickLaw(0.01, 0.3, 0.5)),
    "+ dead time of a tenth of the exposure": replace(PLAIN, law=ClickLaw(dead_time=DeadTime(0.1))),
    "+ afterpulsing 1 %": replace(PLAIN, afterpulse_probability=0.01),
    "+ crosstalk 0.2 %": replace(PLAIN, crosstalk_probability=0.002),
    "+ afterpulsing and crosstalk": replace(PLAIN, afterpulse_probability=0.01, crosstalk_probability=0.002),
}


def bench_sim(options: BenchOptions) -> list[Row]:
    """Return the rows of clicks by effect, and of the optics by how much of a pattern is lit."""
    rows = [_click_row(name, model, options.quick) for name, model in EFFECTS.items()]
    base = rows[0]["ns"]
    for row in rows:
        row["of_plain"] = round(row["ns"] / base, 2)
    return [*rows, *_optics_rows(options), *flow_rows(options.quick)]


def _click_row(name: str, model: DetectorModel, quick: bool) -> Row:
    rng = np.random.default_rng(1)
    photons = rng.exponential(1.0, (OBJECTS, CHANNELS))
    tabulated = cpu_time(lambda: first_click_probability(model, photons), 3).least_s
    probability = first_click_probability(model, photons)
    n = EXPOSURES // 10 if quick else EXPOSURES
    row_of = rng.integers(0, OBJECTS, n)
    words = np.zeros((n, 2), np.uint8)
    place = [0]

    def draw() -> None:
        sample_words(model, probability, row_of, 7, place[0], np.zeros(CHANNELS, np.uint8), words)
        place[0] += n  # other numbers each time

    spent = cpu_time(draw)
    part = row_of[:CHECKED]
    sample_words(model, probability, part, 7, 0, np.zeros(CHANNELS, np.uint8), words[: len(part)])
    wanted = sample_clicks(model, probability[part], 7, 0, np.zeros(CHANNELS, np.uint8))
    found = np.unpackbits(words[: len(part)], axis=1, bitorder="little", count=CHANNELS)
    plain = cpu_time(
        lambda: sample_clicks(
            replace(model, crosstalk_probability=0.0), probability[part], 7, 0, np.zeros(CHANNELS, np.uint8)
        ),
        3,
    )
    return {
        "name": f"SIMULATED clicks, {name}",
        "ns": round(spent.least_s / n / CHANNELS * 1e9, 3),
        "ns_median": round(spent.median_s / n / CHANNELS * 1e9, 3),
        "rate": round(n * CHANNELS / spent.least_s),
        "numpy_ns": round(plain.least_s / len(part) / CHANNELS * 1e9, 2),
        "table_us_per_object": round(tabulated / OBJECTS * 1e6, 3),
        "bits_wrong": int((found != wanted).sum()),
        "mean_clicks": round(float(found.mean()), 5),
        "runs": spent.runs,
    }


def _optics_rows(options: BenchOptions) -> list[Row]:
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (2000, 784), dtype=np.uint8)
    cases: list[tuple[str, Any]] = [
        (
            f"{share:.0%} of the pixels lit",
            np.where(rng.random((32, 784)) < share, rng.integers(1, 124, (32, 784)), 0).astype(np.uint16),
        )
        for share in (0.01, 0.05, 0.2, 1.0)
    ]
    for path in options.bundles:
        bundle, _ = load_bundle(path)
        if bundle.n_pixels == 784:
            cases.append(
                (f"the patterns of {bundle.name}, {np.mean(bundle.pattern_levels > 0):.1%} lit", bundle.pattern_levels)
            )
    rows: list[Row] = []
    profile = load_profile("ideal")
    scene = scene_from_arrays("noise", images.reshape(-1, 28, 28), None, ())
    scale = photons_per_level(profile, 1.0) / 255
    for name, levels in cases:
        spent = cpu_time(lambda: expected_photoelectrons(profile, scene, levels, 1.0), 3)  # noqa: B023
        dense = cpu_time(lambda: images.astype(np.float64) @ levels.astype(np.float64).T, 3)  # noqa: B023
        exact = scale * (images.astype(np.int64) @ levels.astype(np.int64).T)
        found = expected_photoelectrons(profile, scene, levels, 1.0)
        rows.append(
            {
                "name": f"SIMULATED optics, {len(levels)} patterns, {name}",
                "us_per_object": round(spent.least_s / len(images) * 1e6, 3),
                "dense_us": round(dense.least_s / len(images) * 1e6, 3),
                "sums_wrong": int((~np.isclose(found, exact, rtol=1e-13, atol=0.0)).sum()),
            }
        )
    return rows
