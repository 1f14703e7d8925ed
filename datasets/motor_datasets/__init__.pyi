from .arrays import (
    Dataset as Dataset,
)
from .folder import (
    generate_dataset as generate_dataset,
)
from .generate import (
    generate_arrays as generate_arrays,
)
from .layout import (
    Split as Split,
    split_of as split_of,
)
from .loaders import (
    load as load,
    to_pandas as to_pandas,
    to_torch as to_torch,
    to_torch_iterable as to_torch_iterable,
)
from .streaming import (
    stream as stream,
)
