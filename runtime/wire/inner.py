"""The decorators of kernels: `outer` of those that Python calls too, `inner` of those that kernels alone call; neither may allocate.

By itself numba optimises each kernel, makes machine code and two ways in from Python of it, and does all of it again, inlined, in every
kernel that calls it. An inner kernel is compiled only as far as its callers need it and stands in no cache: its callers' cache has it.
It is inlined wherever it is called, since a call would hand over each number of some forty arrays.

A kernel's cache counts for the files of all kernels as they are, since what a kernel calls is compiled into it. It is loaded without
what numba needs to compile, and the collector is off while numba compiles.

This replaces private parts of numba, for the sake of the start. CPU time of `pans demo --pace fast` (2 cores AMD EPYC, numba 0.68):
with an empty cache 11.8 s, with ordinary kernels 24.5 s, with the collector on 13.7 s; from the cache 1.2 s, with numba's own loading
1.5 s. Versions of numba that it was not tried with compile all kernels in the ordinary way, with the same results.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
from numba import njit, types
from numba.core import caching, event
from numba.core.runtime import rtsys

TRIED = ((0, 68),)  # versions of numba
# packages of runtime whose files hold kernels, or constants that are compiled into them
SOURCES = ("core", "decide", "flow", "instrument", "kernel", "record", "timing", "wire")


def outer(function: Any) -> Any:
    """Return `function` as a kernel for Python and for other kernels to call; it must not allocate."""
    if numba.version_info.short not in TRIED:
        return njit(cache=True, nogil=True)(function)
    return _for_these_sources(njit(cache=True, nogil=True, _nrt=False, no_cfunc_wrapper=True)(function))


def inner(function: Any) -> Any:
    """Return `function` as a kernel for other kernels to call, which must not allocate; to call it from Python is a TypeError."""
    if numba.version_info.short not in TRIED:
        return njit(cache=True, nogil=True)(function)
    options = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": _compiler()}
    return njit(nogil=True, _nrt=False, **options)(function)


@cache
def _compiler() -> Any:
    """Return numba's compiler, which keeps the code of a kernel for its callers and makes no more of it."""
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import CompilerBase, DefaultPassBuilder
    from numba.core.compiler_machinery import LoweringPass, register_pass
    from numba.core.typed_passes import AnnotateTypes

    class Kept(JITCodeLibrary):  # type: ignore[misc]
        """Code that is linked into its callers, optimised there, and is nowhere by itself."""

        @property
        def codegen(self) -> Any:
            # whoever asks wants to note the environment of a kernel, which only what is called from Python has
            return SimpleNamespace(set_env=lambda name, environment: None)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            """Return the address of what a call from Python gets: a function of C that raises a TypeError."""
            self._ensure_finalized()
            return ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value or 0

    @register_pass(mutates_CFG=False, analysis_only=False)
    class Keep(LoweringPass):  # type: ignore[misc]
        _name = "keep_for_callers"

        def __init__(self) -> None:
            LoweringPass.__init__(self)

        def run_pass(self, state: Any) -> bool:
            state.library = Kept(state.targetctx.codegen(), state.func_id.func_qualname)
            state.flags.forceinline = any(isinstance(kind, types.BaseTuple) for kind in state.args)
            return True

    class Compiler(CompilerBase):  # type: ignore[misc]
        def define_pipelines(self) -> list[Any]:
            passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
            passes.add_pass_after(Keep, AnnotateTypes)
            passes.finalize()
            return [passes]

    return Compiler


def _for_these_sources(kernel: Any) -> Any:
    """Return `kernel`, whose cache holds what was compiled from these files; without compilation it is a function of Python."""
    file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    if file is not None:
        load_index = file._load_index

        def load_index_again() -> Any:
            """Load the index, which an earlier release may have written with classes that are gone."""
            try:
                return load_index()
            except (AttributeError, ImportError):
                return {}

        file._source_stamp = (file._source_stamp, digest_of(Path(__file__).parents[1]))
        file._load_index = load_index_again
    return kernel


@cache
def digest_of(runtime: Path) -> str:
    """Return a digest of the names, sizes and times of all files of SOURCES in the folder `runtime`."""
    files = [path for package in SOURCES for path in sorted((runtime / package).glob("*.py"))]
    facts = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


class _Uncollected(event.Listener):  # type: ignore[misc]
    """Keeps the collector off while a kernel is compiled: what the compiler makes lives to its end."""

    def __init__(self) -> None:
        self._depth, self._was_on = 0, False

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._was_on = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._was_on:
            gc.enable()


event.register("numba:compile", _Uncollected())


def _load_overload(cache: Any, signature: Any, context: Any) -> Any:
    """Return what numba's `cache` holds for `signature`, None where it holds nothing: as Cache.load_overload, all else left out."""
    rtsys.initialize(context)  # what compiled code may call
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, context)


if numba.version_info.short in TRIED:
    caching.Cache.load_overload = _load_overload
