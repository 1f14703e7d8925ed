"""Labelled transients of brushed DC motors: generated, stored, loaded. `__init__.pyi` lists what is public.

Begin at `generate.generate_arrays`; for files at `folder.generate_dataset`.

Example:
    >>> from motor_datasets import generate_arrays, to_pandas
    >>> from motor_env import load_recipe
    >>> starts = generate_arrays(load_recipe("bench"), seed=1, cases=range(4))
    >>> print(starts.X.shape, to_pandas(starts)["class_name"].tolist())
    (4, 1, 1000) ['winding_contact_25', 'healthy', 'winding_contact_25', 'bearing_25']
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
