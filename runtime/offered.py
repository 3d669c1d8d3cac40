"""An entry point of another package in (command, device, actuator, back end, task, bench); its value, or an error that names the package.

What the value must be is checked by those that use it.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

from .errors import UsageError


def load_offered(point: EntryPoint) -> Any:
    """Return the value of an entry point; UsageError that says which package offers it and why it cannot be loaded."""
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise UsageError(
            f"{point.name!r} of {point.group} cannot be loaded: {point.value}: {error}",
            remedy=f"repair or uninstall {package_of(point)}, which offers it",
        ) from error


def package_of(point: EntryPoint) -> str:
    """Return the name of the installed package that offers `point`."""
    return point.dist.name if point.dist is not None else f"the package of {point.value.partition(':')[0]}"
