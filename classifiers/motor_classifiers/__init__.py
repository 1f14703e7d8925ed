"""Classifiers of motor faults, and the benchmark that compares them. `__init__.pyi` lists what is public.

Begin at `estimators.methods`, and at `scoring.benchmark` for the comparison.

Example:
    A quadratic discriminant on the filter's residual, trained on 400 motors.

    >>> from motor_classifiers import make_method
    >>> from motor_datasets import generate_arrays
    >>> from motor_env import load_recipe
    >>> starts = generate_arrays(load_recipe("bench"), seed=1, cases=range(600))
    >>> model = make_method("residual-qda", load_recipe("bench"), 0).fit(starts.X[:400], starts.class_name[:400])
    >>> print(f"right on {model.score(starts.X[400:], starts.class_name[400:]):.0%} of 200 other motors")
    right on 92% of 200 other motors
"""

from typing import Any

import lazy_loader

from motor_env.common.errors import require_extra

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in __all__:
        require_extra("sklearn", "classifiers")
        require_extra("torch", "classifiers")
    return _load(name)
