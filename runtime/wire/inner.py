"""How kernels are compiled: those that Python calls, and those that kernels alone call, without what only a call from Python needs.

Owns the decorators `outer` and `inner`, and what the compiler is told for them. Neither kind may allocate, so that references need no
counting. By itself numba optimises each kernel, makes machine code of it and adds two ways in from Python, and does all of it again,
inlined, in every kernel that calls it. Of an inner kernel the callers want the code before all that. It is kept in no cache either: where
its callers are loaded from theirs, nobody asks for it. And it is inlined wherever it is called: a call hands over each number of each
array by itself, and a turn has some forty arrays.

Kernels are loaded from the cache alone: numba would first bring in all that it can compile, and scipy where that is installed, which took
a quarter of a second in each process that only loads. Whatever is compiled brings that in by itself.

The cache of a kernel is for its file as it is. What it calls and what it knows of other files is compiled in, too, so here a kernel is
for all files that kernels are made from: behind a change in any of them, all are compiled again.

What is left out here is numba's own, which has no option for it: other versions of numba than those it was tried with compile inner
kernels like all others, which takes longer and gives the same results.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
import os
from functools import cache
from pathlib import Path
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


_made: list[Any] = []


def _compiler() -> Any:
    """Return numba's compiler, which keeps the code of a kernel for its callers and makes no more of it."""
    if not _made:
        from numba.core.codegen import JITCodeLibrary
        from numba.core.compiler import CompilerBase, DefaultPassBuilder
        from numba.core.compiler_machinery import LoweringPass, register_pass
        from numba.core.typed_passes import AnnotateTypes

        class Kept(JITCodeLibrary):  # type: ignore[misc]
            """Code that is linked into its callers, optimised there, and is nowhere by itself."""

            @property
            def codegen(self) -> Any:
                return _NoEnvironment

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

        _made.append(Compiler)
    return _made[0]


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
    """Return a digest of the names, sizes and times of all files of SOURCES in the folder `runtime`; "" where they cannot be read."""
    digest = hashlib.sha256()
    try:
        for package in SOURCES:
            with os.scandir(runtime / package) as entries:
                for entry in sorted(entries, key=lambda one: one.name):
                    if entry.name.endswith(".py"):
                        facts = entry.stat()
                        digest.update(f"{package}/{entry.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    except OSError:  # in an archive, say
        return ""
    return digest.hexdigest()


class _NoEnvironment:
    """Stands for the code generator where it is to note the environment of a kernel, which only what is called from Python has."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        pass


class _Uncollected(event.Listener):  # type: ignore[misc]
    """Keeps the collector off while a kernel is compiled: what the compiler makes lives to its end, and to look at it took a quarter."""

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
