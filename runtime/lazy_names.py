"""Public names of a package that are loaded when they are first asked for.

Owns one function. A package's `__init__` uses it for names whose modules compile kernels or load a large library, so that importing
the package stays fast.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], object]:
    """Return a module `__getattr__` that loads a name from its module on first use (PEP 562).

    `homes` maps each public name to the module that defines it, relative to `package` (".model") or absolute. Other names raise
    AttributeError.

    >>> get = lazy_names("pans.runtime", {"EXIT_FINE": ".cli"})
    >>> get("EXIT_FINE")
    0
    """

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value: object = getattr(importlib.import_module(homes[name], package), name)
        if package in sys.modules:
            setattr(sys.modules[package], name, value)  # the next access is an ordinary one
        return value

    return load
