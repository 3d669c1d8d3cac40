"""From a device URL to stamped bytes, and a session on them up to arming.

What comes in are URLs (`serial:`, `usb:`, and the schemes of the entry points `pans.devices`), a plan and a bundle; what goes out are
frames with the time of their arrival. Start with base.py, then connection.py. Whether a bundle fits the profile is checked in
core/plan.py; fit.py repeats that with what the device reports of itself. What a run does when a device is lost is in live.

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
