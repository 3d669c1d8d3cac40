"""Where a training computes: on the processor, or on a CUDA device, by the same code.

The same seed gives the same result on one device and one version of torch; devices draw other random numbers, so that results differ.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from pans.base.errors import UsageError

from .processor import settle

CHOICE = settle()  # before torch's first operation
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h


@contextmanager
def computing_on(name: str) -> Iterator[None]:
    """Let torch make its tensors on `name` (cpu or cuda) meanwhile; UsageError for a device that is not there."""
    if name == "cuda" and not torch.cuda.is_available():
        built = torch.version.cuda
        raise UsageError(
            "--device cuda: no CUDA device can be used here"
            + (" (this torch was built without CUDA)" if built is None else f" (torch was built for CUDA {built})"),
            remedy="use --device cpu, or install a torch with CUDA on a machine with such a device",
        )
    before = torch.get_default_device()
    torch.set_default_device(name)
    try:
        yield
    finally:
        torch.set_default_device(before)


def here(tensor: Tensor) -> Tensor:
    """Return `tensor` on the chosen device: what comes from numpy never is."""
    return tensor.to(torch.get_default_device())


def keep_freed_memory() -> None:
    """Let the C library keep memory that was freed, where it is glibc: tensors of a megabyte are else mapped anew by every operation.

    Training of an automaton took a third less processor time with it. It holds for the process.
    """
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return
    mallopt(M_MMAP_THRESHOLD, 1 << 30)
    mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1)


def new_generator(seed: int) -> torch.Generator:
    """Return a generator of random numbers on the chosen device."""
    return torch.Generator(device=torch.get_default_device()).manual_seed(seed)


def product_dtype() -> torch.dtype:
    """Return the type of training's matrix products: the fastest that works on the device (see processor.py).

    Grey values and one-bit patterns are exact in bfloat16, sums are float32; final figures are always float32 or wider.
    """
    if torch.get_default_device().type == "cuda":
        return torch.bfloat16
    return torch.float32 if CHOICE is None else getattr(torch, CHOICE.products)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread within, as the commands do; also a decorator.

    Trainings are of many small steps. `PansClassifier.fit` of 30 images of 4 pixels (2 cores): 0.06 s, on two threads 0.86 s.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
