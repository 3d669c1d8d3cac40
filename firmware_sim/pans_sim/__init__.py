"""The simulated instrument: an ordinary device that speaks the wire protocol, in virtual or real time.

A profile, a scene and bytes from a host come in; bytes of the protocol go out. Start with `device.instrument`, the state machine; `scene`
computes light and clicks, `ports` puts the instrument behind links, `conform` tests other people's firmware.
`python -m pans_sim` is `pans simulate`.
"""
