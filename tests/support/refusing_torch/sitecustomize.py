"""A processor that announces what it refuses: with this folder on PYTHONPATH, torch's bfloat16 products and all convolutions fail.

PANS_REFUSES says how: "raise" as oneDNN does, "die" by an illegal instruction. Under ONEDNN_MAX_CPU_ISA, convolutions work; bfloat16
works where PANS_REFUSES ends with "-unlimited".
"""

import importlib.machinery
import os
import signal
import sys
from importlib.abc import MetaPathFinder

PRODUCTS = {"matmul", "__matmul__", "__rmatmul__", "mm", "addmm", "bmm", "baddbmm", "linear", "einsum", "tensordot"}


class _Finder(MetaPathFinder):
    """Finds torch as usual, and lets `_refuse` follow its import."""

    def find_spec(self, name, path=None, target=None):
        if name != "torch":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None:
            execute = spec.loader.exec_module

            def exec_module(module):
                execute(module)
                _refuse(module)

            spec.loader.exec_module = exec_module
        return spec


def _refuse(torch):
    from torch.overrides import TorchFunctionMode

    how = os.environ["PANS_REFUSES"]

    def is_coarse(values):
        tensors = [value for value in values if isinstance(value, torch.Tensor)]
        return any(value.dtype == torch.bfloat16 for value in tensors) or torch.is_autocast_enabled("cpu")

    class Refusing(TorchFunctionMode):
        def __torch_function__(self, func, types, args=(), kwargs=None):
            name = getattr(func, "__name__", "")
            limited = bool(os.environ.get("ONEDNN_MAX_CPU_ISA"))
            coarse = name in PRODUCTS and is_coarse(args) and not (limited and how.endswith("-unlimited"))
            if coarse or (name.startswith("conv") and not limited):
                if how.startswith("die"):
                    os.kill(os.getpid(), signal.SIGILL)
                raise RuntimeError("could not create a primitive")
            return func(*args, **(kwargs or {}))

    Refusing().__enter__()


if os.environ.get("PANS_REFUSES"):
    sys.meta_path.insert(0, _Finder())
