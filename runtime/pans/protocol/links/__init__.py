"""From a device URL to stamped bytes: serial, USB, simulated, replayed.

In: a URL. Out: a `Link`, whose reader stamps bytes with the host's time as they arrive. `LINKS` in base.py is the table of links; the
entry points `pans.devices` add to it.

>>> from pans.protocol.links import open_link
>>> open_link("nothing")
Traceback (most recent call last):
    ...
pans.base.errors.UsageError: 'nothing' is no device URL
  remedy: write scheme:target, for example sim:ideal or serial:/dev/ttyACM0
"""

from .base import LINKS, TracedLink, checked_scheme, descriptor_of, link_facts, open_link, opened_again
from .link import Link
from .reader import Chunk, LinkReader, count_delimiters
from .serial import FTDI_SLOW_MS, latency_timer_ms
from .usb import UsbLink

__all__ = [
    "FTDI_SLOW_MS",
    "LINKS",
    "Chunk",
    "Link",
    "LinkReader",
    "TracedLink",
    "UsbLink",
    "checked_scheme",
    "count_delimiters",
    "descriptor_of",
    "latency_timer_ms",
    "link_facts",
    "open_link",
    "opened_again",
]
