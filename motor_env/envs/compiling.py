"""The step is compiled when it is first used, which takes half a minute: that is said, and can be done beforehand."""

from __future__ import annotations

import logging

from numba.core import event

from motor_env.motor.compiled import njit

# numba counts who holds an array, at every view of one: that made the end of an episode cost three times as much. So
# the step does without, and a function of it that makes arrays (with the counting) must not call one that returns some.
compiled = njit(cache=True, error_model="numpy", _nrt=False)
compiled_with_arrays = njit(cache=True, error_model="numpy", _nrt=True)
inlined = njit(forceinline=True, error_model="numpy", _nrt=False)

_LOG = logging.getLogger("motor_env")


class _Notice(event.Listener):
    """Says once a process that the environments are being compiled. What numba finds in its cache is not."""

    said = False

    def on_start(self, event: event.Event) -> None:
        """Something begins to be compiled."""
        module = event.data["dispatcher"].py_func.__module__
        if not self.said and module.startswith("motor_env.envs."):
            self.said = True
            _LOG.warning(
                "motor_env compiles its environments for this machine: about half a minute, once "
                "(`motor-env warm-up` does it beforehand)"
            )

    def on_end(self, event: event.Event) -> None:
        """Something has been compiled."""


def announce() -> None:
    """From now on say when something is compiled."""
    if not _registered:
        event.register("numba:compile", _NOTICE)
        _registered.append(True)


_NOTICE = _Notice()
_registered: list[bool] = []
