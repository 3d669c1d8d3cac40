"""Draws docs/pictures/frontier.png from docs/results/frontier.json: FashionMNIST accuracy by photons and by light sent. SIMULATED.

python docs/pictures/frontier.py       (extra `plot`)

Each curve joins the points of one way that no other point of it beats; bars are two standard errors. All points: docs/results/frontier.md.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from matplotlib.ticker import NullFormatter

from pans.trainer.figures import new_figure, save_figure

HERE = Path(__file__).parent
WAYS = {  # curve: begins of the names of its ways, colour
    "automaton, few photons": (("automaton, held to clicks", "automaton, trained", "automaton", "larger"), "#d1495b"),
    "automaton, little light sent": (("automaton, held to light sent",), "#7b3fa0"),
    "camera": (("direct,",), "#1f6fb2"),
    "fixed patterns": (("ours, fixed, held",), "#b36a00"),
}
AXES = {"photons": "photons detected per decision", "illumination": "illumination (light sent) per decision"}
