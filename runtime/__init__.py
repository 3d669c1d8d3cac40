"""The lean runtime: from a trained bundle to timed decisions on single-photon clicks."""

__version__ = "0.1.0"
