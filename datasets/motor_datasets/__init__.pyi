from .arrays import (
    Dataset as Dataset,
)
from .generate import (
    generate_arrays as generate_arrays,
    generate_dataset as generate_dataset,
)
from .loaders import (
    load as load,
    to_pandas as to_pandas,
    to_torch as to_torch,
)
from .splits import (
    Split as Split,
    split_of as split_of,
)
from .streaming import (
    stream as stream,
    to_torch_iterable as to_torch_iterable,
)
