"""How the environments' steps are compiled."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core.cgutils import gep_inbounds
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from motor_env.motor.compiled import njit

# numba counts who holds an array, at every view of one: that made the end of an episode cost three times as much. So
# the step does without, and a function of it that makes arrays (with the counting) must not call one that returns some.
compiled = njit(cache=True, error_model="numpy", _nrt=False)
compiled_with_arrays = njit(cache=True, error_model="numpy", _nrt=True)
inlined = njit(forceinline=True, error_model="numpy", _nrt=False)


@intrinsic(prefer_literal=True)
def fixed_tuple(context: Any, array: Any, length: Any) -> Any:
    """So many numbers of a contiguous array as a tuple, one load each.

    numba's own `to_fixed_tuple` copies the whole tuple for each number: two microseconds for seventy of them.
    """
    made = types.UniTuple(array.dtype, length.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = make_array(array)(context, builder, arguments[0]).data
        values = [builder.load(gep_inbounds(builder, numbers, k)) for k in range(made.count)]
        return context.make_tuple(builder, made, values)

    return made(array, length), generate
