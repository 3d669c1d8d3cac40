"""Kernels that kernels alone call, compiled without what only a call from Python needs.

Owns `inner`, the decorator, and what the compiler is told for it. By itself numba optimises each kernel, makes machine code of it and adds
two ways in from Python, and does all of it again, inlined, in every kernel that calls it. Of an inner kernel the callers want the code
before all that. It is kept in no cache either: where its callers are loaded from theirs, nobody asks for it. And it is inlined wherever it
is called: a call hands over each number of each array by itself, and a turn has some forty arrays.

What is left out here is numba's own, which has no option for it: other versions of numba than those it was tried with compile inner
kernels like all others, which takes longer and gives the same results.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numba
from numba import njit

TRIED = ((0, 68),)  # versions of numba


def inner(function: Any) -> Any:
    """Return `function` as a kernel for other kernels to call; to call it from Python is a TypeError."""
    if numba.version_info.short not in TRIED:
        return njit(cache=True, nogil=True)(function)
    options = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True, "pipeline_class": _compiler()}
    return njit(nogil=True, **options)(function)


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
                return True

        class Compiler(CompilerBase):  # type: ignore[misc]
            def define_pipelines(self) -> list[Any]:
                passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
                passes.add_pass_after(Keep, AnnotateTypes)
                passes.finalize()
                return [passes]

        _made.append(Compiler)
    return _made[0]


class _NoEnvironment:
    """Stands for the code generator where it is to note the environment of a kernel, which only what is called from Python has."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        pass
