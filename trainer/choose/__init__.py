"""Choosing a training for a user's own images: how they may be varied, the encoder, the size of the training, and what to warn of.

Owns the rules, each with the reason that is printed; never trains. `choose_training` returns a `Recipe`.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .recipe import Choice, Recipe, choose_encoder, choose_training, choose_variation, class_warnings, warnings_of

__all__ = ["Choice", "Recipe", "choose_encoder", "choose_training", "choose_variation", "class_warnings", "warnings_of"]

__getattr__ = lazy_names(
    __name__,
    {
        "Recipe": ".recipe",
        "choose_encoder": ".recipe",
        "choose_training": ".recipe",
        "class_warnings": ".recipe",
        "warnings_of": ".recipe",
        "Choice": ".variations",
        "choose_variation": ".variations",
    },
)
