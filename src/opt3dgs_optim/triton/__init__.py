"""The step of a parameter as one Triton launch on a GPU."""

from opt3dgs_optim.step import Hyper, Step


def takes(step: Step) -> bool:
    """Whether the kernels make this step."""
    return False


def take_step(step: Step, hyper: Hyper) -> None:
    """Make the step in one launch."""
    raise NotImplementedError


def missing() -> str | None:
    """Why the kernels cannot run in this process, or None."""
    return "not yet"


def interpreted_difference() -> float | None:
    """How far the kernels, run by Triton's interpreter, are from torch."""
    return None
