"""The differentiable parts of a training in torch: encoders, detection, heads, and estimators of the gradient.

Objects come in, photoelectrons, clicks and scores go out. Start with `encoders.py` and `detection.py`.

>>> import torch
>>> from pans.instrument.click_law import ClickLaw
>>> from pans_trainer.model.detection import click_probability
>>> click_probability(torch.tensor([0.0, 1.0]), ClickLaw())
tensor([0.0000, 0.6321])
"""
