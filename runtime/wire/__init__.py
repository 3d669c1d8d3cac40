"""Protocol 1 without I/O, for both ends: bytes to messages and back, the host's session, and what of a stream was lost.

Owns the layouts of docs/reference/protocol.md, framing and checksums, and the account of sequence numbers. Opens no port and reads no
clock: bytes and times are arguments. Nothing is compiled until `FrameDecoder.use_kernels`. Messages have an `encode_*` and a `decode_*`
each in wire.messages, the bodies of commands a `pack_*` and an `unpack_*` in wire.commands.

>>> from pans.runtime.wire import FrameDecoder, Mark, MessageType, encode_mark
>>> sent = encode_mark(Mark(seq=0, object_index=7, truth=2, exposure_index=0, tick=1000, photons=4.5), session=1)
>>> [(MessageType(frame.type).name, frame.session) for frame in FrameDecoder().feed(sent)]
[('MARK', 1)]
"""

from .frame import Frame, Messages
from .framing import FrameDecoder, encode_frame
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
