from .arrays import (
    Dataset as Dataset,
)
from .folder import (
    generate_dataset as generate_dataset,
)
from .generate import (
    Split as Split,
    generate_arrays as generate_arrays,
    split_of as split_of,
    stream as stream,
)
from .loaders import (
    load as load,
    to_pandas as to_pandas,
    to_torch as to_torch,
    to_torch_iterable as to_torch_iterable,
)
