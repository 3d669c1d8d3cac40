"""The head of a bundle: an ONNX graph that is checked before it runs, its layers, its int8 form.

Start at onnx_check.py (what a head may hold), then layers.py.
"""

from .layers import STEP_MAX, Int8Head, Layer, quantise_head, read_layers, reference_scores
from .onnx_check import FLOAT, check_head, protobuf

__all__ = [
    "FLOAT",
    "STEP_MAX",
    "Int8Head",
    "Layer",
    "check_head",
    "protobuf",
    "quantise_head",
    "read_layers",
    "reference_scores",
]
