"""Error against run time, of any trainer: a log while it trains, a report on the logs.

Nothing here needs the optimizers. `opt3dgs report` is `runs.report`.
"""

from opt3dgs_optim.runs.lines import Run, read_run
from opt3dgs_optim.runs.log import RunLog

__all__ = ["Run", "RunLog", "read_run"]
