"""The wire protocol, version 1, without I/O and for both ends: bytes to messages and back, the host's session, the account of losses.

What comes in are bytes and times; what goes out are frames, named tuples, bytes to send and gaps. docs/reference/protocol.md is the
specification; start with framing.py, then messages.py, commands.py and session.py.

>>> from pans.runtime.wire import FrameDecoder, Mark, MessageType, encode_mark
>>> sent = encode_mark(Mark(seq=0, object_index=7, truth=2, exposure_index=0, tick=1000, photons=4.5), session=1)
>>> [(MessageType(frame.type).name, frame.session) for frame in FrameDecoder().feed(sent)]
[('MARK', 1)]
"""

from .framing import FrameDecoder
from .messages import Mark, encode_mark
from .schema import MalformedMessage, MessageType
from .session import HostSession
from .tracker import StreamTracker

__all__ = ["FrameDecoder", "HostSession", "MalformedMessage", "Mark", "MessageType", "StreamTracker", "encode_mark"]
