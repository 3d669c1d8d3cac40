"""The decorators of kernels: `outer` of those that Python calls too, `inner` of those that kernels alone call; neither may allocate.

By itself numba optimises each kernel, makes machine code and two ways in from Python of it, and does all of it again, inlined, in every
kernel that calls it. An inner kernel is compiled only as far as its callers need it and stands in no cache: its callers' cache has it.
It is inlined wherever it is called, since a call would hand over each number of some forty arrays.

What is compiled is kept once per machine and user, for all environments with the same sources, numba and Python: in a folder that is
named by what the sources hold, not by where they are or when they were written, since what a kernel calls is compiled into it. It is
loaded without what numba needs to compile, and the collector is off while numba compiles. Kernels that allocate take `njit` from here.

This replaces private parts of numba, for the sake of the start. CPU time of `pans demo --pace fast` (2 cores AMD EPYC, numba 0.68):
with an empty cache 11.8 s, with ordinary kernels 24.5 s, with the collector on 13.7 s; from the cache 1.2 s, with numba's own loading
1.5 s. Versions of numba that it was not tried with compile all kernels in the ordinary way, with the same results.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import llvmlite
import numba
from numba import njit as njit
from numba import types
from numba.core import caching, event
from numba.core.runtime import rtsys

from pans.base import __version__
from pans.base.console.printing import warn
from pans.base.files.output_files import own_folder, user_cache

TRIED = ((0, 68),)  # versions of numba
# Folders whose files hold kernels, or constants that are compiled into them: of pans for all kernels, of the others for their own.
SOURCES = ("base/machine", "bundle/backends", "decide", "instrument", "protocol", "record")
OTHERS = {"pans": ("app/bench",), "pans_sim": ("device", "scene"), "pans_trainer": ("train/automaton", "baselines")}
KEPT, KEPT_AT_LEAST_S = 4, 3600.0  # folders of other sources that stay; those in use always
FOLDER = re.compile(r"pans-kernels-[\w.+]+-[0-9a-f]{16}")


def outer(function: Any) -> Any:
    """Return `function` as a kernel for Python and for other kernels to call; it must not allocate."""
    if numba.version_info.short not in TRIED:
        return njit(cache=True, nogil=True)(function)
    return njit(cache=True, nogil=True, _nrt=False, no_cfunc_wrapper=True)(function)


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


class _Place(caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """Where numba keeps what it compiles of pans, and what that depends on."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        self._module, self._cache_path = function.__module__, str(kernel_folder())

    def ensure_cache_path(self) -> None:
        """Make the folder again if it was removed meanwhile."""
        os.makedirs(self._cache_path, mode=0o700, exist_ok=True)

    def get_source_stamp(self) -> str:
        """Return the digest of the other sources that this kernel may depend on."""
        package = self._module.split(".")[0]
        return digest_of(Path(str(sys.modules[package].__file__)).parent, OTHERS[package])

    def get_disambiguator(self) -> str:
        """Return what tells kernels of one name apart."""
        return f"{self._module}-{self._lineno}"

    @classmethod
    def from_function(cls, function: Any, file: str) -> _Place | None:
        """Return the place for a function of pans, None for others."""
        name = str(function.__module__)
        return cls(function, file) if name.split(".")[0] in OTHERS else None


caching.CacheImpl._locator_classes.insert(0, _Place)


@cache
def kernel_folder() -> Path:
    """Return the folder of what is compiled of these sources: in NUMBA_CACHE_DIR or the user's cache; else one for this process alone.

    What lies there is run: a folder that another user owns, or could change or replace, is not used.
    """
    facts = (numba.__version__, llvmlite.__version__, digest_of(Path(__file__).parents[2], SOURCES))
    name = f"pans-kernels-{__version__}-{hashlib.sha256(repr(facts).encode()).hexdigest()[:16]}"
    try:
        place = Path(numba.config.CACHE_DIR or user_cache()) / name
        is_new = not place.exists()
        folder = own_folder(place)
        os.utime(folder)  # in use
        if is_new:
            _prune(folder)
        return folder
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        warn(f"kernels are compiled at each start, for some ten seconds: {error}; NUMBA_CACHE_DIR names another folder")
    made = tempfile.mkdtemp(prefix="pans-kernels-")
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return Path(made)


def _prune(folder: Path) -> None:
    """Remove the folders of other sources beside `folder`, but for those used last."""
    others = [path for path in folder.parent.iterdir() if FOLDER.fullmatch(path.name) and path != folder]
    used_s = {path: path.lstat().st_mtime for path in others}
    for path in sorted(others, key=used_s.__getitem__)[:-KEPT]:
        if time.time() - used_s[path] > KEPT_AT_LEAST_S:
            shutil.rmtree(path, ignore_errors=True)


@cache
def digest_of(top: Path, packages: tuple[str, ...]) -> str:
    """Return a digest of the names and contents of all files of `packages` in the folder `top`."""
    digest = hashlib.sha256()
    for path in (path for package in packages for path in sorted((top / package).rglob("*.py"))):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(top).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


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
        found = cache._load_overload(signature, context)
    # two processes that compiled at the same time may have given one name to two files
    return found if found is not None and tuple(found.signature.args) == tuple(signature) else None


def _save_overload(cache: Any, signature: Any, data: Any) -> None:
    """Keep what was compiled, where that can be done: a full disk costs the next start its time, not this run."""
    with suppress(OSError):
        cache._save_overload(signature, data)


if numba.version_info.short in TRIED:
    caching.Cache.load_overload, caching.Cache.save_overload = _load_overload, _save_overload
