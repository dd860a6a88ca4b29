"""Print the lines to change in a training script as a diff; `--write` applies them.

gsplat's simple_trainer.py, the train.py of INRIA's gaussian-splatting, 3dgs-mcmc and derivatives. A
file whose names cannot be read with certainty is refused, with the lines to add by hand.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from opt3dgs_optim.hosts.edits import LINES_BY_HAND, diff, write


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 where the file was edited, else 1."""
    parser = argparse.ArgumentParser("opt3dgs hosts", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("diff", help="print the changed lines for a trainer's file")
    command.add_argument("path", type=Path, help="simple_trainer.py or train.py")
    command.add_argument("--write", action="store_true", help="apply them, keep PATH.orig")
    options = parser.parse_args(arguments)
    try:
        done = diff(options.path)
        backup = write(options.path) if options.write else None
    except ValueError as error:
        print(f"opt3dgs hosts: {options.path}: {error}", file=sys.stderr)
        if options.path.is_file() and options.path.suffix == ".py":
            print("\n".join(["The lines to add by hand:", *LINES_BY_HAND]), file=sys.stderr)
        return 1
    print(done.diff, end="")
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    if backup is not None:
        print(f"{options.path} changed, the old file is {backup}")
    return 0
