"""The simulated instrument behind links: in virtual time, a pseudo-terminal, TCP, pyserial, pyusb, with faults on the way.

A device URL comes in, an ordinary link goes out. Start with `serve` (the URL and what is made from it); `shell` is the loop at real pace,
`virtual` the link in virtual time, `faulty` a bad link between.

>>> from pans_sim.ports import open_sim, parse_faults
>>> open_sim("sim:ideal?pace=fast&scene=uniform").virtual
True
>>> parse_faults("loss:0.5").loss
0.5
"""

from .faults import Faults, parse_faults
from .serve import open_sim

__all__ = ["Faults", "open_sim", "parse_faults"]
