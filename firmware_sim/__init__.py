"""The simulated instrument: an ordinary device that speaks the wire protocol, in virtual or real time.

Scenes give photoelectrons and clicks (scene), the instrument is a state machine without I/O (device), shells bring it to pipes, ports
and buses (ports), and long checks of the whole system run against it (trials). `python -m pans.firmware_sim` is `pans simulate`.
"""
