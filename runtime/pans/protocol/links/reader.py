"""Stamped chunks from a link: the loop reads for itself while it waits, and a helper thread reads while the loop is busy.

A hand-over between threads costs more
than a round trip to the instrument, so whoever waits for bytes reads them: `wait` takes the lock on reading. When the loop has been
busy for longer than LOOK_EVERY_S, the helper thread reads into the queue, and hands reading back when `wait` is called. Every
chunk is stamped right after its read by whoever read it, and one reader at a time keeps their order.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from pans.base.errors import PansError

if TYPE_CHECKING:
    from .link import Link

LOOK_EVERY_S = 0.002  # how often the helper looks whether the loop is busy
HELPER_POLL_S = 0.005  # and how long it may keep a loop that has come back waiting, if nothing arrives
EAGER_NS = 200_000
REST_NS = 1_000_000_000  # how long a device that goes on sending is listened to when its link is given up
MAX_QUEUED_BYTES = 1 << 24


class Chunk(NamedTuple):
    """Bytes as they came from the link, with the host time at which they were there."""

    arrival_ns: int
    data: bytes


def count_delimiters(data: bytes) -> int:
    """Return how many frames end in `data`, of which each is long: bytes.count would look at one byte after the other."""
    count, at = 0, data.find(0)
    while at >= 0:
        count, at = count + 1, data.find(0, at + 1)
    return count


class LinkReader:
    """Stamped chunks from a link; a helper thread reads for a busy loop, unless the link's time is virtual.

    The queue is bounded by MAX_QUEUED_BYTES: above it the helper stops reading, so that the transport and then the receive
    window hold the device back. The end of a link, or of the thread, is kept and raised by every further `wait`.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._reading = threading.Lock()  # whoever holds it reads the link
        self._chunks: deque[Chunk] = deque()
        self._queued_bytes = 0
        self._ready = threading.Condition()
        self._death: BaseException | None = None
        self._away = True  # the loop does something else
        self._visits = 0  # how often the loop has read
        self._helping = False
        self._stopping = False
        self._needed = threading.Event()  # the helper
        self._needed.set()
        self._thread: threading.Thread | None = None
        if not link.virtual:
            self._thread = threading.Thread(target=self._watch, name="pans-link-reader", daemon=True)
            self._thread.start()

    @property
    def thread_id(self) -> int | None:
        """Native id of the helper thread, for the scheduler; None without one."""
        return None if self._thread is None else self._thread.native_id

    def wait(self, timeout_s: float, *, eager: bool = False) -> list[Chunk]:
        """Return the chunks that are there, waiting at most `timeout_s` for the first; LinkError when the link is gone.

        `eager` when an answer is due at once: the first EAGER_NS are waited awake, since falling asleep and waking take
        about as long as the answer itself.
        """
        self._away = False
        self._visits += 1
        try:
            if self._reading.acquire(blocking=False):
                try:
                    if not self._chunks and self._death is None:
                        data = self._read_awake() if eager and self._thread is not None else b""
                        data = data or self._link.read(timeout_s)
                        return [Chunk(self._link.now_ns(), data)] if data else []
                except Exception as error:
                    self._death = error
                    raise
                finally:
                    self._reading.release()
            return self._queued(timeout_s)
        finally:
            self._away = True

    def ahead(self, timeout_s: float, frames: int, size: int, until_ns: int) -> Sequence[tuple[int, bytes]]:
        """Read a virtual link again and again, each time as `wait` does, and return what came, as chunks.

        No more is read once `frames` delimiters or `size` bytes have come, the link's clock has passed `until_ns`, or a read brings nothing
        or fails: the next `wait` meets that again.
        """
        if self._link.reads_ahead:
            return self._link.read_ahead(timeout_s, frames, size, until_ns)
        chunks: list[Chunk] = []
        with suppress(PansError):  # kept
            while frames > 0 and size > 0 and self._link.now_ns() < until_ns and (more := self.wait(timeout_s)):
                chunks += more
                frames -= count_delimiters(more[0].data)
                size -= len(more[0].data)
        return chunks

    def lend(self, *, long: bool = False) -> bool:
        """Leave the link to the caller, who reads it himself until `take_back`; False where chunks wait or somebody reads.

        With `long` the helper sleeps meanwhile: it need not look whether the loop is busy.
        """
        self._away = False
        self._visits += 1
        if not self._chunks and self._death is None and self._reading.acquire(blocking=False):
            if not self._chunks:  # the helper has put none before it let go
                if long:
                    self._needed.clear()
                return True
            self._reading.release()
        self._away = True
        return False

    def take_back(self) -> None:
        """Read for a busy loop again; it counts as busy from here on."""
        self._reading.release()
        if not self._needed.is_set():
            self._needed.set()
        self._visits += 1
        self._away = True

    def stop(self) -> None:
        """Stop the thread; the link stays as it is."""
        self._stopping = True
        self._needed.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            with self._ready:
                self._ready.notify_all()
            self._thread.join(timeout=2.0)

    def rest(self) -> list[Chunk]:
        """Stop the thread and return what has arrived and nobody has taken: in the queue, then in the link, as far as it can be read."""
        self.stop()
        chunks = list(self._chunks)
        self._chunks.clear()
        until_ns = self._link.now_ns() + REST_NS
        with suppress(PansError):  # the link is gone, and with it what stood in it
            while self._death is None and (data := self._link.read(0.0)):
                chunks.append(Chunk(self._link.now_ns(), data))
                if self._link.now_ns() > until_ns:
                    break
        return chunks

    def close(self) -> None:
        """Stop the thread and close the link."""
        self.stop()
        self._link.close()

    def _read_awake(self) -> bytes:
        link = self._link
        until_ns = link.now_ns() + EAGER_NS
        while not (data := link.read(0.0)) and link.now_ns() < until_ns:
            pass
        return data

    def _queued(self, timeout_s: float) -> list[Chunk]:
        """Take what the helper has read, or is about to; nothing as soon as it has handed reading back."""
        deadline_s = time.monotonic() + timeout_s
        with self._ready:
            while self._helping and not self._chunks and self._death is None:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    break
                self._ready.wait(left_s)
            chunks = list(self._chunks)
            self._chunks.clear()
            self._queued_bytes = 0
            self._ready.notify_all()
        if not chunks and self._death is not None:
            raise self._death
        return chunks

    def _watch(self) -> None:
        seen = -1
        try:
            while not self._stopping:
                self._needed.wait()
                time.sleep(LOOK_EVERY_S)
                if self._away and self._visits == seen:
                    self._help()
                seen = self._visits
        except BaseException as error:  # whatever ends the thread must end the run loudly, not leave it waiting
            with self._ready:
                self._death = error
                self._helping = False
                self._ready.notify_all()

    def _help(self) -> None:
        """Read until the loop is back."""
        self._helping = True  # before the lock is taken: who finds it taken may wait
        try:
            if self._reading.acquire(blocking=False):
                try:
                    while self._away and not self._stopping:
                        data = self._link.read(HELPER_POLL_S)
                        if data:
                            self._put(Chunk(self._link.now_ns(), data))
                finally:
                    self._reading.release()
        finally:
            with self._ready:
                self._helping = False
                self._ready.notify_all()

    def _put(self, chunk: Chunk) -> None:
        with self._ready:
            while self._queued_bytes > MAX_QUEUED_BYTES and not self._stopping:
                self._ready.wait(HELPER_POLL_S)
            self._chunks.append(chunk)
            self._queued_bytes += len(chunk.data)
            self._ready.notify_all()
