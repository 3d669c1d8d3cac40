"""The rules that a device is tried by, in the words of docs/reference/protocol.md, section 12: one function each, by what it needs.

sessions.py: connecting, time and leases. frames.py: bytes. orders.py: commands out of order. runs.py: exposures and gates.
automata.py: states. counts.py: photon numbers. exposed.py: when exposures happened. A new rule is a function with `@rule`.
"""

from . import automata, counts, exposed, frames, orders, runs, sessions

__all__ = ["automata", "counts", "exposed", "frames", "orders", "runs", "sessions"]
