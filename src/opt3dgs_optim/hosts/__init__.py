"""The package in other people's trainers: `opt3dgs hosts diff PATH_TO_TRAINER`.

`edits` writes the lines that a training script needs, `nerfstudio` adds methods to nerfstudio.
"""

from opt3dgs_optim.hosts.edits import Edited, diff, write

__all__ = ["Edited", "diff", "write"]
