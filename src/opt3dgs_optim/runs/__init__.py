"""Error against run time, of any trainer: a log while it trains, a report on the logs.

Nothing here needs the optimizers. `python -m opt3dgs_optim report` is `runs.report`.
"""

from opt3dgs_optim.runs.log import RunLog
from opt3dgs_optim.runs.read import Run, read_run

__all__ = ["Run", "RunLog", "read_run"]
