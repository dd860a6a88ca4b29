"""Hypothesis profiles: the same examples in each run, unless somebody asks for others.

`HYPOTHESIS_PROFILE=random python -m pytest` explores; with `--hypothesis-seed=N` it repeats itself.
"""

import logging
import os
from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))

torch.set_num_threads(1)  # tensors are small, and other processes of the test run need the cores


@pytest.fixture(autouse=True)
def level_of_the_log() -> Iterator[None]:
    """Programs of examples/ set it for their process, which is that of the tests."""
    logger = logging.getLogger("opt3dgs_optim")
    level = logger.level
    yield
    logger.setLevel(level)


@pytest.fixture(autouse=True)
def no_line_of_an_early_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests leave hundreds of trainings unfinished; each would say so in a line."""
    from opt3dgs_optim.messages import End

    monkeypatch.setattr(End, "say", lambda *_: None)
