"""Teach a robot a skill from one demonstration (SART).

What the author of a skill, robot, task, backend, strategy or policy needs is listed in
`__init__.pyi` and imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
