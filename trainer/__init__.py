"""The torch trainer: patterns and heads trained through the physics of an instrument, and exported as bundles (extra `train`).

Owns tasks, models, training, export, evaluation, baselines and the paper's tables; never talks to a device.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .options import Options, check_options

__all__ = ["Options", "check_options"]

__getattr__ = lazy_names(__name__, {"Options": ".options", "check_options": ".options"})
