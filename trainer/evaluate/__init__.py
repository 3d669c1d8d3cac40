"""What a bundle decides on held-out objects, against photons, and how much its clicks know of the label.

Owns the sampled and the exact evaluation through a profile's optics and detector, information measures, and pictures of a bundle.
It needs numpy and the runtime alone, and never trains. All figures are SIMULATED.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .accuracy import Conditions, Light, Measured, MeasuredPictures, light_of
    from .held_out import evaluate, measure

__all__ = ["Conditions", "Light", "Measured", "MeasuredPictures", "evaluate", "light_of", "measure"]

__getattr__ = lazy_names(
    __name__,
    {
        "Light": ".accuracy",
        "Measured": ".accuracy",
        "MeasuredPictures": ".accuracy",
        "light_of": ".accuracy",
        "Conditions": ".accuracy",
        "evaluate": ".held_out",
        "measure": ".held_out",
    },
)
