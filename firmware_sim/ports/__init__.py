"""Shells around the device: in process and in virtual time, pseudo-terminal, TCP, pyserial, pyusb, and faults on the way.

Owns device URLs of the simulator, file descriptors, threads and child processes; never looks into a message further than a fault needs.
`open_sim` returns an ordinary link.

>>> from pans.firmware_sim.ports import open_sim, parse_faults
>>> open_sim("sim:ideal?pace=fast&scene=uniform").virtual
True
>>> parse_faults("loss:0.5").loss
0.5
"""

from .faults import Faults, parse_faults
from .serve import open_sim

__all__ = ["Faults", "open_sim", "parse_faults"]
