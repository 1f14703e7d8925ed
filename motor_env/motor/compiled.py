"""Functions compiled by numba, with a cache that is never stale and whose failure never stops a command.

numba notices only a change of a function's own file; this cache is keyed by a digest of its helpers and constants,
too.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import EnumType
from functools import cache, wraps
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.dispatcher import Dispatcher
from numba.core.registry import CPUDispatcher
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]  # it has no types

try:
    from numba._dynfunc import make_function
except ImportError:  # an inner part of numba
    make_function = None

P = ParamSpec("P")
T = TypeVar("T")


@cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  # it finds what has been loaded

    return ThreadpoolController()


def on_one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with NumPy's and SciPy's linear algebra on one thread while it runs."""

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> T:
        with _controller().limit(limits=1):
            return function(*args, **kwargs)

    return alone


@cache
def _say_once() -> None:
    sys.stderr.write("numba's cache cannot be read or written: compiling without it\n")


def _gather(module: ModuleType, sources: dict[str, bytes]) -> None:
    """Collect the sources and constants that code compiled in a module depends on."""
    sources[module.__name__] = b""  # two modules may use each other
    own_package = module.__name__.partition(".")[0]
    text, others = [inspect.getsource(module)], []
    for name, value in sorted(vars(module).items()):
        if isinstance(value, Dispatcher):
            text.append(f"{name} {sorted(value.targetoptions.items())}")
            others.append(sys.modules[value.py_func.__module__])
        elif isinstance(value, ModuleType) and value.__name__.partition(".")[0] == own_package:
            others.append(value)
        elif isinstance(value, EnumType):
            text.append(f"{name} {list(value.__members__.items())}")
        elif isinstance(value, type) and issubclass(value, tuple):
            text.append(f"{name} {getattr(value, '_fields', ())}")
        elif isinstance(value, np.ndarray):
            text.append(f"{name} {value.dtype.str} {value.shape} {value.tobytes().hex()}")
        elif isinstance(
            value, bool | int | float | str | tuple | np.generic | np.dtype
        ) and not name.startswith("__"):
            text.append(f"{name} {value!r}")
    sources[module.__name__] = "\n".join(text).encode()
    for other in others:
        if other.__name__ not in sources:
            _gather(other, sources)


@cache
def source_digest(module_name: str) -> str:
    """Return the digest of all sources and constants that code compiled in a module depends on."""
    sources: dict[str, bytes] = {}
    _gather(sys.modules[module_name], sources)
    return hashlib.sha256(
        b"\0".join(name.encode() + b"\0" + sources[name] for name in sorted(sources))
    ).hexdigest()


class _KeptCache(FunctionCache):
    """numba's cache of a function, keyed by digest; a file of it that cannot be read or written is ignored."""

    def _stamp(self) -> None:
        """Record the version of the code at the first call, when all of its module has been run."""
        self._cache_file._source_stamp = source_digest(self._py_func.__module__)  # noqa: SLF001  # no public way

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for these types; None where it has to be compiled."""
        try:
            self._stamp()
            return super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001  # a damaged file can raise anything
            _say_once()
            with suppress(OSError):
                self.flush()  # so that the next process finds a whole one
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            self._stamp()
            super().save_overload(sig, data)
        except Exception:  # noqa: BLE001  # see above
            _say_once()


_WAITS = {
    "motor_env.envs.maintain.": ("the environment Maintain", "about 5 seconds"),
    "motor_env.envs.drive.": ("the environment Drive", "about 5 seconds"),
    "motor_env.envs.": ("its environments", "about half a minute"),
    "motor_env.diagnosis.estimation.": ("the fit of a recording", "about 5 seconds"),
    "motor_env.filters.": ("the filter", "about 3 seconds"),
    "motor_env.simulation.": ("the simulation", "about 5 seconds"),
}
"""What is compiled, and for how long on an ordinary machine, by the beginning of a module's name."""


class _Notice(event.Listener):
    """Report once a process what is compiled, before the wait; a function in the cache causes no notice."""

    said = False

    def on_start(self, event: event.Event) -> None:
        dispatcher = event.data["dispatcher"]
        if self.said or sys.stderr is None or not isinstance(dispatcher._cache, _KeptCache):  # noqa: SLF001
            return
        module = dispatcher.py_func.__module__
        known = next((wait for start, wait in _WAITS.items() if module.startswith(start)), None)
        if known is not None:
            self.said = True
            sys.stderr.write(
                f"motor-env compiles {known[0]} for this machine: {known[1]}, once"
                " (`motor-env warm-up` does it beforehand)\n"
            )
            sys.stderr.flush()

    def on_end(self, event: event.Event) -> None:
        """Do nothing; numba calls it when a compilation ends."""


_NOTICE = _Notice()
event.register("numba:compile", _NOTICE)


@contextmanager
def without_notice() -> Iterator[None]:
    """Switch the notice off, for programs that report themselves what they compile."""
    before, _NOTICE.said = _NOTICE.said, True
    try:
        yield
    finally:
        _NOTICE.said = before


class _LinkedCode(JITCodeLibrary):
    """Code of a part: linked into its callers and optimised there, never compiled to machine code by itself."""

    # numba has no public name for any of this; that halves the time LLVM takes for the environments.

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout  # noqa: SLF001

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)  # noqa: SLF001
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)  # noqa: SLF001
        self._finalized = True


class _PartCompiler(Compiler):
    """numba's compiler without the machine code, as a part has no entry of its own."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        context = self.state.targetctx
        self.state.library = _LinkedCode(context.codegen(), "part")
        context.get_executable = lambda library, fndesc, env: make_function(
            fndesc.lookup_module(), fndesc.qualname, "", 0, env, (library,)
        )


_CAN_LINK_ONLY = make_function is not None and all(
    hasattr(JITCodeLibrary, name) for name in ("_optimize_functions", "_get_module_for_linking", "finalize")
)
"""Whether numba's internals are as expected here; elsewhere parts compile the usual way, in twice the time."""


class _Part(CPUDispatcher):
    """Function that only compiled ones call: it has no entry for Python."""

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(f"{self.py_func.__name__} is called by compiled functions alone")


def njit(
    *, cache: bool = False, is_part: bool = False, **options: Any
) -> Callable[[Callable[..., Any]], Any]:
    """Return `numba.njit` with a cache that may fail; a part is called only by compiled functions: no cache."""

    def compiled(function: Callable[..., Any]) -> Any:
        # Nothing calls them from C: numba's wrappers for that take a tenth of the time of compiling.
        if is_part and _CAN_LINK_ONLY:
            options["pipeline_class"] = _PartCompiler
        dispatcher = numba.njit(no_cfunc_wrapper=True, no_cpython_wrapper=is_part, **options)(function)
        if is_part:
            dispatcher.__class__ = _Part
        elif cache:
            try:
                dispatcher._cache = _KeptCache(function)  # noqa: SLF001  # as its enable_caching() does
            except RuntimeError:  # neither the package's folder nor the user's can be written
                _say_once()
        return dispatcher

    return compiled


# numba counts who holds an array, with a locked instruction at every view of one and at every call with one. In a loop
# over samples that was three quarters of the time. So loops do without it, on arrays that their caller has made:
# without it a function can make none, and must not call one that returns some, as nobody would let go of them.
# What stands in its callers is optimised once more in each of them: what is large or seldom run is called instead.
compiled = njit(cache=True, error_model="numpy", _nrt=False)
compiled_with_arrays = njit(cache=True, error_model="numpy", _nrt=True)
inlined = njit(is_part=True, forceinline=True, error_model="numpy", _nrt=False)
compiled_part = njit(is_part=True, error_model="numpy", _nrt=False)
