"""Ground for all rooms: errors, checked numbers, files, console, the machine; nothing here knows of photons.

In: bytes, paths, options, text. Out: checked values, errors with a remedy, files written whole.
Other rooms import errors, numbers, files, console and machine.
Start at errors.py (what an error says), then files/output_files.py and console/options.py.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"
SHIPPED = Path(__file__).parents[1] / "shipped"  # bundles, settings and rules that come with the package


def loaded_later(package: str, *modules: str) -> Callable[[str], Any]:
    """Return a `__getattr__` (PEP 562) for a face: what its `__all__` names of `modules` is loaded at its first use.

    For modules that load numpy or numba, which a command that only lists or asks does not need.
    """

    def load(name: str) -> Any:
        if name in sys.modules[package].__all__:
            for module in modules:
                there = vars(import_module(f"{package}.{module}"))
                if name in there:
                    return there[name]
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load
