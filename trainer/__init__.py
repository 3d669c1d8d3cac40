"""The torch trainer: patterns and heads trained through the physics of an instrument, and exported as bundles (extra `train`).

Owns tasks, models, training, export, evaluation, baselines and the paper's tables; never talks to a device.
"""

from .options import Options, check_options

__all__ = ["Options", "check_options"]
