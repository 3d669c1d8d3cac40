"""The differentiable parts: detection, encoders, heads, estimators of the gradient, similarity of pictures.

Owns the physics between light and clicks in torch, and the networks before and behind it; never a training loop and never a file.

>>> import torch
>>> from pans.runtime.instrument.click_law import ClickLaw
>>> from pans.trainer.model import click_probability
>>> click_probability(torch.tensor([0.0, 1.0]), ClickLaw())
tensor([0.0000, 0.6321])
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .detection import click_probability, sample_clicks
    from .encoders import new_encoder
    from .estimators import ESTIMATORS
    from .heads import new_head

__all__ = ["ESTIMATORS", "click_probability", "new_encoder", "new_head", "sample_clicks"]

__getattr__ = lazy_names(
    __name__,
    {
        "click_probability": ".detection",
        "sample_clicks": ".detection",
        "new_encoder": ".encoders",
        "ESTIMATORS": ".estimators",
        "new_head": ".heads",
    },
)
