"""Draws optics.png: accuracy of bundles against misalignment, exact expectations of the first 2000 test images, SIMULATED.

Usage: python docs/pictures/optics.py BUNDLE... (needs the extra plot and PANS_DATA); without any, the two shipped ones.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pans.bundle.sensor import load_bundle
from pans_trainer.commands.evaluate import optics_curve_words
from pans_trainer.evaluate.held_out import held_out_of
from pans_trainer.evaluate.optics import misalignment_curves
from pans_trainer.evaluate.pictures import draw_optics
from pans_trainer.options import Conditions

OBJECTS = 2000

if __name__ == "__main__":
    drawn = {}
    for name in sys.argv[1:] or ["fashion10", "fashion-adaptive"]:
        bundle = load_bundle(name)[0]
        held_out = held_out_of(bundle, None, OBJECTS, None, Conditions())
        about = Conditions().imaging_on(held_out.profile)
        drawn[bundle.name] = misalignment_curves(bundle, held_out, about)
        print(optics_curve_words(bundle.name, OBJECTS, about, drawn[bundle.name]))
    print(draw_optics(Path(__file__).parent, drawn, force=True))
