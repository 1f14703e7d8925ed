"""How the environments' steps are compiled."""

from __future__ import annotations

from motor_env.motor.compiled import njit

# numba counts who holds an array, at every view of one: that made the end of an episode cost three times as much. So
# the step does without, and a function of it that makes arrays (with the counting) must not call one that returns some.
compiled = njit(cache=True, error_model="numpy", _nrt=False)
compiled_with_arrays = njit(cache=True, error_model="numpy", _nrt=True)
inlined = njit(forceinline=True, error_model="numpy", _nrt=False)
