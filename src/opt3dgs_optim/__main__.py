"""The commands: `opt3dgs`, or `python -m opt3dgs_optim`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from opt3dgs_optim.version import __version__

COMMANDS = {
    "doctor": "versions, which backend runs and why, and a self-test",
    "report": "compare runs from their logs: error against run time",
    "hosts": "the lines to change in your trainer, as a diff or applied",
}
MODULES = {"report": "runs.report", "hosts": "hosts.__main__"}


def usage() -> str:
    """The list of commands."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items())
    head = f"opt3dgs_optim {__version__}\n\nopt3dgs COMMAND ..."
    return f"{head}\n\n{rows}\n\nopt3dgs COMMAND --help says more."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its status; 2 for one that does not exist, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    if words[0] not in COMMANDS:
        print(f"opt3dgs_optim: no command {words[0]!r}\n\n{usage()}", file=sys.stderr)
        return 2
    try:
        module = MODULES.get(words[0], words[0])
        return importlib.import_module(f"opt3dgs_optim.{module}").main(words[1:])
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
