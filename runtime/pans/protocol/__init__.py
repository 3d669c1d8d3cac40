"""Host and device on one wire, without a run: messages, session, stream position, device clock, links.

In: a device URL, bytes and times. Out: messages, commands to send, gaps, device ticks in host time.
Other rooms import wire, session, tracker, clock and links. The specification is docs/reference/protocol.md.
Start at wire/framing.py, then wire/messages.py and session.py.
"""
