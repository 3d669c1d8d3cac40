"""`pans doctor`: what this computer can do, each finding with its remedy. Start at command.py."""

from typing import TYPE_CHECKING

from pans.base import loaded_later

if TYPE_CHECKING:
    from .command import Finding

__all__ = ["Finding"]

__getattr__ = loaded_later(__name__, "command")
