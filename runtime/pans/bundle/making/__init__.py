"""From patterns in photons to a bundle: whole levels, what they cost, patterns from pictures."""

from .cost import quantisation_cost
from .pattern_files import about, array_parts, head_with_facts, pattern_pngs, read_pattern_pngs
from .quantise import DITHER_LEVELS_MAX, QuantisedPatterns, quantise_patterns

__all__ = [
    "DITHER_LEVELS_MAX",
    "QuantisedPatterns",
    "about",
    "array_parts",
    "head_with_facts",
    "pattern_pngs",
    "quantisation_cost",
    "quantise_patterns",
    "read_pattern_pngs",
]
