"""Records and tuples of numbers in contiguous arrays, for the compiled steps of the environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import from_dtype, types
from numba.core.cgutils import gep_inbounds
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numba.np.numpy_support import as_dtype


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


def record_maker(type_of: Callable[[np.dtype[Any]], np.dtype[np.void]], length: int) -> Any:
    """A compiled function (array, number): a record of so many numbers in a contiguous array, which is not copied.

    An array of records would cost 0.1 us a call more than one of numbers.

    Args:
        type_of: gives the record's type for that of the array.
        length: of a record, in numbers.
    """

    @intrinsic
    def record(context: Any, array: Any, number: Any) -> Any:
        made = from_dtype(type_of(as_dtype(array.dtype)))

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            numbers = make_array(array)(context, builder, arguments[0]).data
            first = builder.mul(arguments[1], arguments[1].type(length))
            return builder.bitcast(gep_inbounds(builder, numbers, first), context.get_value_type(made))

        return made(array, number), generate

    return record
