"""Names of the decision back ends, ours and those that a lab's own package offers; loads none of them.

Owns the entry point group. A maker is called with the bundle and returns a `Decider` (verdict.py); backends.py checks it before use.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

BACKENDS = ("auto", "table", "count-table", "sparse", "onnx", "int8", "int8-onnx", "float64", "automaton")
GROUP = "pans.backends"


def offered_backends() -> dict[str, EntryPoint]:
    """Return the back ends of other packages by name; a name of ours cannot be taken."""
    return {point.name: point for point in entry_points(group=GROUP) if point.name not in BACKENDS}


def backend_names() -> tuple[str, ...]:
    """Return every name that `make_decider` knows."""
    return (*BACKENDS, *sorted(offered_backends()))
