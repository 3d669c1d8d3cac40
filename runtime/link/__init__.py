"""A port: from a device URL to stamped bytes, and a session on them.

Owns the schemes (`serial:`, `usb:`, and those of the entry points `pans.devices`), the thread that reads, and the conversation before
arming. It never interprets clicks and never decides how a run goes on when a device is lost (live).

>>> from pans.runtime.link import open_link
>>> open_link("nothing")
Traceback (most recent call last):
    ...
pans.runtime.errors.UsageError: 'nothing' is no device URL
  remedy: write scheme:target, for example sim:ideal or serial:/dev/ttyACM0
"""

from .base import Link, open_link
from .connection import Connection

__all__ = ["Connection", "Link", "open_link"]
