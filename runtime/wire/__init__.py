"""The wire protocol, version 1, without I/O and for both ends: bytes to messages and back, the host's session, the account of losses.

What comes in are bytes and times; what goes out are frames, named tuples, bytes to send and gaps. docs/reference/protocol.md is the
specification; start with framing.py, then messages.py, commands.py and session.py.

>>> from pans.runtime.wire import FrameDecoder, Mark, MessageType, encode_mark
>>> sent = encode_mark(Mark(seq=0, object_index=7, truth=2, exposure_index=0, tick=1000, photons=4.5), session=1)
>>> [(MessageType(frame.type).name, frame.session) for frame in FrameDecoder().feed(sent)]
[('MARK', 1)]
"""

from .framing import Frame, FrameDecoder, Messages, encode_frame
from .messages import (
    ClickBlock,
    FrameBlock,
    Mark,
    Status,
    Welcome,
    decode_clicks,
    decode_frames,
    decode_mark,
    decode_status,
    encode_clicks,
    encode_frames,
    encode_mark,
    encode_status,
)
from .schema import DeviceState, MalformedMessage, MessageType, Opcode
from .session import HostSession
from .tracker import Gap, StreamTracker

__all__ = [
    "ClickBlock",
    "DeviceState",
    "Frame",
    "FrameBlock",
    "FrameDecoder",
    "Gap",
    "HostSession",
    "MalformedMessage",
    "Mark",
    "MessageType",
    "Messages",
    "Opcode",
    "Status",
    "StreamTracker",
    "Welcome",
    "decode_clicks",
    "decode_frames",
    "decode_mark",
    "decode_status",
    "encode_clicks",
    "encode_frame",
    "encode_frames",
    "encode_mark",
    "encode_status",
]
