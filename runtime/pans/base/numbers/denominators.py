"""Of which decisions a figure is: `decisions` (all), `decided` (not abstained), `judged` (not abstained, true class known).

Accuracy, clicks and photons of a run are of one group: the narrowest that has any decision. Nothing large is loaded: the process that
draws the live view uses it.

>>> counts = {"decisions": 4686, "decided": 2525, "judged": 2500}
>>> group_of(counts), group_words(counts)
('judged', 'of the 2,500 decisions with a label and a known true class')
>>> group_words({"decisions": 20, "decided": 20, "judged": 20})
''
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

GROUPS = ("judged", "decided", "decisions")  # each is a part of the next
_WORDS = {"judged": "with a label and a known true class", "decided": "with a label"}


def group_of(counts: Mapping[str, Any]) -> str:
    """Return the group of which accuracy, clicks and photons are; `counts` has the number of decisions of each."""
    return next((name for name in GROUPS if counts[name]), "decisions")


def group_words(counts: Mapping[str, Any]) -> str:
    """Return of how many decisions the figures are; "" where they are of all."""
    name = group_of(counts)
    return "" if counts[name] == counts["decisions"] else f"of the {counts[name]:,} decisions {_WORDS[name]}"
