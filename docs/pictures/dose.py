"""Draws dose.png: accuracy of the shipped bundles against dose, patterns in three orders, exact over the test images, SIMULATED.

Usage: python docs/pictures/dose.py [OBJECTS [CAPPED.pans ...]] (needs the extra plot and PANS_DATA; a minute for all 10 000 images).
CAPPED.pans are automata trained under caps on fashion-mnist: one more curve, a point for each.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

from pans.bundle.sensor import load_bundle
from pans.instrument.optics import NO_BLEACHING
from pans_trainer.commands.evaluate import dose_curve_words
from pans_trainer.evaluate.dose import dose_curve
from pans_trainer.evaluate.held_out import held_out_of, measure
from pans_trainer.evaluate.pictures import draw_dose
from pans_trainer.export.ordering import information_order, reordered
from pans_trainer.options import Conditions

if __name__ == "__main__":
    objects = int(sys.argv[1]) if len(sys.argv) > 1 else None
    fixed, walks = load_bundle("fashion10")[0], load_bundle("fashion-adaptive")[0]
    held_out = held_out_of(fixed, None, objects, None, Conditions())
    bundles = {"fashion10, as trained": (fixed, held_out)}
    for by in ("information", "dose"):
        order = information_order(fixed, held_out.profile, held_out.task.train, by=by)
        bundles[f"fashion10, by {by}"] = (reordered(fixed, order.patterns, {}), held_out)
    bundles["fashion-adaptive"] = (walks, held_out_of(walks, None, objects, None, Conditions()))
    drawn = {}
    for name, (bundle, judged_on) in bundles.items():
        drawn[name] = dose_curve(bundle, judged_on, Conditions())
        print(dose_curve_words(name, len(judged_on.objects), NO_BLEACHING, drawn[name]))
    capped = [load_bundle(path)[0] for path in sys.argv[2:]]
    if capped:
        name = "automata trained under caps"
        drawn[name] = [asdict(measure(one, held_out_of(one, None, objects, None, Conditions()))) for one in capped]
    print(draw_dose(Path(__file__).parent, drawn, force=True))
