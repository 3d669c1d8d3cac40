"""A stand-in of ALP4lib 1.1.0 by its public interface: the same names, parameters and errors, with the table of bench_light behind it.

What the controller would refuse raises ALPError with the vendor's code: a busy or a removed device, pictures that do not exist or were
never loaded, a first picture behind the last one, light that is shorter than the bit planes allow.
"""

from __future__ import annotations

import ctypes as ct
import time

import numpy as np
from bench_light import TABLE

ALP_DEVICE_NUMBER, ALP_DEV_STATE, ALP_AVAIL_MEMORY = 2000, 2002, 2003
ALP_SEQ_REPEAT, ALP_FIRSTFRAME, ALP_LASTFRAME = 2100, 2101, 2102
ALP_ERRORS = {
    1001: "The specified ALP device has not been found or is not ready.",
    1002: "The ALP device is not in idle state.",
    1005: "One of the parameters is invalid.",
    1007: "The requested memory is not available (full?).",
    1008: "The sequence specified is currently in use.",
    1012: "The specified ALP has been removed.",
}
MEMORY = 43_690
SHORTEST_US = {1: 10, 8: 3400}
CALL_S = 100e-6  # of a command over USB


class ALPError(Exception):
    def __init__(self, error_code: int) -> None:
        super().__init__(ALP_ERRORS[error_code])


class _Sequence:
    def __init__(self, count: int, depth: int) -> None:
        self.pictures: dict[int, np.ndarray] = {}
        self.count, self.depth, self.first, self.last, self.light_us = count, depth, 0, count - 1, 33_000


class ALP4:
    def __init__(self, version: str = "4.3", libDir: str | None = None) -> None:
        if version not in ("4.1", "4.2", "4.3", "4.4", "5.0", "5.1"):
            raise ValueError("Version not supported.")
        print("Loading library: stand-in")
        self._open, self._all, self._lastDDRseq, self.Seqs = False, {}, None, []

    def Initialize(self, DeviceNum: int | None = None) -> None:
        if not TABLE.is_plugged("alp"):
            raise ALPError(1001)
        self._open = True
        self.nSizeY, self.nSizeX = TABLE.size
        print(f"DMD found, resolution = {self.nSizeX} x {self.nSizeY}.")

    def SeqAlloc(self, nbImg: int = 1, bitDepth: int = 1) -> ct.c_long:
        self._ready()
        if nbImg * bitDepth > MEMORY:
            raise ALPError(1007)
        identity = ct.c_long(len(self._all))
        self._all[identity.value] = _Sequence(nbImg, bitDepth)
        self.Seqs.append(identity)
        self._lastDDRseq = identity
        return identity

    def SeqPut(self, imgData, SequenceId=None, PicOffset=0, PicLoad=0, dataFormat="Python") -> None:  # type: ignore[no-untyped-def]
        sequence = self._sequence(SequenceId)
        if TABLE.now() < TABLE.busy_to:
            raise ALPError(1008)
        pictures = np.asarray(imgData).astype(np.uint8).reshape(PicLoad or sequence.count, *TABLE.size)
        if not 0 <= PicOffset <= sequence.count - len(pictures):
            raise ALPError(1005)
        for number, picture in enumerate(pictures, PicOffset):
            top = picture >> (8 - sequence.depth)  # the highest bits are shown
            sequence.pictures[number] = np.packbits(top.astype(bool)) if sequence.depth == 1 else top

    def SetTiming(
        self, SequenceId=None, illuminationTime=None, pictureTime=None, synchDelay=None, synchPulseWidth=None, triggerInDelay=None
    ) -> None:  # type: ignore[no-untyped-def]  # fmt: skip
        sequence = self._sequence(SequenceId)
        light = ct.c_long(illuminationTime).value
        if light < SHORTEST_US[sequence.depth]:
            raise ALPError(1005)
        sequence.light_us = light

    def SeqControl(self, controlType, value, SequenceId=None) -> None:  # type: ignore[no-untyped-def]
        sequence, value = self._sequence(SequenceId), ct.c_long(value).value
        if controlType == ALP_FIRSTFRAME and 0 <= value <= sequence.last:
            sequence.first = value
        elif controlType == ALP_LASTFRAME and sequence.first <= value < sequence.count:
            sequence.last = value
        elif controlType != ALP_SEQ_REPEAT or value != 1:
            raise ALPError(1005)

    def DevInquire(self, inquireType: int) -> int:
        self._ready()
        return {ALP_DEVICE_NUMBER: 4711, ALP_AVAIL_MEMORY: MEMORY, ALP_DEV_STATE: 0}[inquireType]

    def Run(self, SequenceId=None, loop=True) -> None:  # type: ignore[no-untyped-def]
        sequence = self._sequence(SequenceId)
        if sequence.first != sequence.last or loop:
            raise NotImplementedError("here a display is one picture, once")
        if sequence.first not in sequence.pictures:
            raise ALPError(1005)
        picture = sequence.pictures[sequence.first]
        if sequence.depth == 1:
            picture = np.unpackbits(picture).reshape(TABLE.size)
        TABLE.display(picture / (2**sequence.depth - 1), sequence.light_us)

    def Wait(self) -> None:
        self._ready()
        time.sleep(max(0, TABLE.busy_to - TABLE.now()) * 1e-12)

    def Halt(self) -> None:
        self._ready()
        TABLE.dark()

    def FreeSeq(self, SequenceId=None) -> None:  # type: ignore[no-untyped-def]
        self._sequence(SequenceId)
        self.Seqs.remove(SequenceId)
        del self._all[SequenceId.value]

    def Free(self) -> None:
        self._ready()
        if TABLE.now() < TABLE.busy_to:
            raise ALPError(1002)
        self._open = False

    def _ready(self) -> None:
        time.sleep(CALL_S)
        if not self._open:
            raise ALPError(1001)
        if not TABLE.is_plugged("alp"):
            raise ALPError(1012)

    def _sequence(self, identity: ct.c_long | None) -> _Sequence:
        self._ready()
        identity = identity or self._lastDDRseq
        if identity is None or identity.value not in self._all:
            raise ALPError(1005)
        return self._all[identity.value]
