"""Hypothesis profiles: the same examples in each run, unless somebody asks for others.

`HYPOTHESIS_PROFILE=random python -m pytest` explores; with `--hypothesis-seed=N` it repeats itself.
"""

import os

from hypothesis import settings

settings.register_profile("fixed", derandomize=True)
settings.register_profile("random", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))
