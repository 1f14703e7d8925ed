"""Gymnasium environments in which a motor may be failing, textbook policies for them, scores and bounds.

`import motor_env` registers the ids. Everything is loaded when first used; `__init__.pyi` lists what is public.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
