"""`python -m pans_trainer.export.tape_bundle`: a bundle for a tape of bars, one bar per pattern, with guard bands and an exact table.

Nothing is trained: a window has 1024 strings, so that the Bayes table and its accuracy are sums. Light falls on the middle of each bar
alone: a tape off by less than the guard band changes nothing. A table is made for one dark rate; make another for another.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import add_options, option, options_from
from pans.bundle.sensor import BackEnd, Bundle, Shown, make_bundle, write_bundle
from pans.instrument.profile import Profile, load_profile
from pans_trainer.evaluate.readings import outcome_probabilities
from pans_trainer.tasks.barcode import CLASSES, N_BARS, all_strings

F64 = NDArray[np.float64]
FLOOR = 1e-6  # of a posterior in the table


def bar_patterns(pixels_per_bar: int, lit_px: int) -> NDArray[np.uint8]:
    """Return one pattern per bar, 1 on the `lit_px` pixels in its middle: uint8 (10, 10 * pixels_per_bar)."""
    if not 1 <= lit_px <= pixels_per_bar or (pixels_per_bar - lit_px) % 2:
        what = f"{lit_px} lit pixels of {pixels_per_bar}: allowed are 1 to {pixels_per_bar}, with equal guard bands"
        raise ValueError(what)
    guard = (pixels_per_bar - lit_px) // 2
    lit = np.zeros((N_BARS, N_BARS, pixels_per_bar), np.uint8)
    lit[np.arange(N_BARS), np.arange(N_BARS), guard : guard + lit_px] = 1
    return lit.reshape(N_BARS, -1)


def exact_table(photons: float, dark: float) -> tuple[NDArray[np.float32], float, float]:
    """Return log posteriors float32 (words, 2) for uniform strings, and the exact accuracy and mean clicks of deciding by them."""
    bars, labels = all_strings()
    given = outcome_probabilities(-np.expm1(-(photons * bars + dark)), 1) / len(labels)  # bit i of a word: bar i clicks
    joint = np.stack([given[labels == label].sum(axis=0) for label in range(len(CLASSES))], axis=1)
    clicks = float((given.sum(axis=0) * np.array([int(word).bit_count() for word in range(len(joint))])).sum())
    posterior = joint / np.maximum(joint.sum(axis=1, keepdims=True), 1e-300)
    return np.log(np.maximum(posterior, FLOOR)).astype(np.float32), float(joint.max(axis=1).sum()), clicks


@dataclass(frozen=True, slots=True)
class Tape:
    """How a tape is lit, and what a detector has of it."""

    photons: float = option(8.0, "photoelectrons of a bright bar (default 8)")
    dark: float = option(0.0, "dark photoelectrons per exposure (default 0)")
    pixels_per_bar: int = option(8, "default 8")
    lit_px: int = option(2, "lit pixels in the middle of a bar (default 2)")
    exposure_us: float = option(5.0, "default 5")


def tape_bundle(profile: Profile, tape: Tape) -> tuple[Bundle, dict[str, Any]]:
    """Return the bundle and its exact figures; ValueError where the projector is not bright enough."""
    photons, dark, lit_px, exposure_us = tape.photons, tape.dark, tape.lit_px, tape.exposure_us
    levels = profile.projector.levels
    top = profile.projector.peak_photoelectrons_hz * exposure_us * 1e-6
    level = round(photons / lit_px / top * (levels - 1))
    if not 1 <= level < levels:
        raise ValueError(
            f"{photons:g} photoelectrons on {lit_px} pixels need level {level} of {levels - 1} in {exposure_us:g} us: "
            "choose another exposure, or more lit pixels"
        )
    shown = level / (levels - 1) * top * lit_px
    table, accuracy, clicks = exact_table(shown, dark)
    figures = {
        "exact_accuracy": accuracy,
        "clicks_mean": clicks,
        "photons_mean": shown * N_BARS / 2,
        "photons_per_bright_bar": shown,
        "dark": dark,
    }
    bundle = make_bundle(
        name=f"tape, one bar per pattern, dark {dark:g}",
        task="barcode",
        classes=CLASSES,
        image_shape=(1, N_BARS * tape.pixels_per_bar),
        optics=Shown(levels, bar_patterns(tape.pixels_per_bar, lit_px).astype(np.uint16) * level, top / (levels - 1)),
        back_end=BackEnd(table=table),
        provenance={
            "made_by": "pans_trainer.export.tape_bundle",
            "profile": profile.name,
            "exposure_us": exposure_us,
            **figures,
        },
    )
    return bundle, figures


def main() -> None:
    """Write the bundle and print its exact figures as JSON."""
    parser = argparse.ArgumentParser(description="a bundle for a tape of bars: one bar per pattern, exact table")
    parser.add_argument("--profile", default="flow-snspd", help="hardware profile (default flow-snspd)")
    add_options(parser, Tape)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the bundle to write")
    parser.add_argument("--force", action="store_true", help="replace it if it exists")
    args = parser.parse_args()
    bundle, figures = tape_bundle(load_profile(args.profile), options_from(args, Tape))
    write_bundle(bundle, args.out, force=args.force)
    print(json.dumps({"bundle": str(args.out), **figures}))


if __name__ == "__main__":
    main()
