"""The commands: `opt3dgs`, or `python -m opt3dgs_optim`."""

import importlib
import os
import sys
from collections.abc import Sequence

from opt3dgs_optim.version import __version__

MODULES = {
    "lines": "hosts.lines",
    "doctor": "doctor",
    "report": "runs.report",
}
USAGE = f"""opt3dgs_optim {__version__}

opt3dgs COMMAND ...

  lines   the three lines for your trainer, printed or put into its script
  doctor  versions, what runs on this machine and why, and a self-test
  report  compare runs from their logs: error against run time

opt3dgs COMMAND --help says more."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its status; 2 for one that does not exist, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    if words[0] not in MODULES:
        print(f"opt3dgs: no command {words[0]!r}\n\n{USAGE}", file=sys.stderr)
        return 2
    try:
        return importlib.import_module(f"opt3dgs_optim.{MODULES[words[0]]}").main(words[1:])
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `| head` has read enough
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        return 0


if __name__ == "__main__":
    raise SystemExit(main())
