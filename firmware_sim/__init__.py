"""The simulated instrument: an ordinary device that speaks the wire protocol, in virtual or real time."""
