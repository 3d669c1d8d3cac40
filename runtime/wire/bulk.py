"""The names under which the kernel's callers know the decoder, until the live loop has one kernel."""

from .framing import CHUNK_BYTES as CHUNK_BYTES
from .framing import FrameDecoder as BulkDecoder

__all__ = ["CHUNK_BYTES", "BulkDecoder"]
