"""The lines to change in a trainer: `python -m opt3dgs_optim.hosts diff PATH_TO_TRAINER`.

Prints them as a diff; `--write` applies them and leaves the old file beside it as `.orig`. Known
are gsplat's `simple_trainer.py` (1.5.3 to 1.6) and the `train.py` of INRIA's gaussian-splatting,
3dgs-mcmc and their many forks. A trainer is recognised by the lines that have to change; any other
file is refused. nerfstudio needs no change: `opt3dgs_optim.nerfstudio` adds methods to it.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

IMPORT = "from opt3dgs_optim import PhaseScheduler"


@dataclass(frozen=True)
class Edit:
    """One changed line.

    Args:
        anchor: a regular expression that exactly one line (or statement) of the file matches; its
            group `indent`, if any, is the new line's indentation.
        line: the new line, or how to make it of the match.
        where: whether it goes after the anchor, before it, or instead of it.
        what: the anchor in words.
    """

    anchor: str
    line: str | Callable[[re.Match[str]], str]
    where: Literal["after", "before", "instead"]
    what: str


@dataclass(frozen=True)
class Host:
    """A trainer: its name and its edits."""

    name: str
    edits: tuple[Edit, ...]


_BACKWARD = r"^(?P<indent>[ \t]+)loss\.backward\(\)[ \t]*$"
_GSPLAT_START = (
    Edit(
        r"^from gsplat\.strategy import [^\n(]*$",
        IMPORT,
        "after",
        "from gsplat.strategy import ...",
    ),
    Edit(
        r"^(?P<indent>[ \t]+)self\.splats, self\.optimizers = create_splats_with_optimizers\("
        r"(?:\n(?P=indent)[ \t]+[^\n]*)*\n(?P=indent)\)[ \t]*$",
        "self.phases, self.optimizers = PhaseScheduler.install(self.optimizers, cfg.max_steps, "
        "process_group=torch.distributed.group.WORLD if world_size > 1 else None)",
        "after",
        "self.splats, self.optimizers = create_splats_with_optimizers(...)",
    ),
)
_GSPLAT_OBSERVE = Edit(_BACKWARD, "self.phases.observe(loss)", "after", "loss.backward()")
_GSPLAT_L1 = Edit(
    r"^(?P<indent>[ \t]+)l1loss = F\.l1_loss\((?P<pair>\w+, \w+)\)[ \t]*$",
    lambda match: f"l1loss = self.phases.pixel_loss({match['pair']})",
    "instead",
    "l1loss = F.l1_loss(...)",
)
# 1.6 has the L1 term twice, with and without masks, by a function of that name.
_GSPLAT_L1_BY_NAME = Edit(
    r"^(?P<indent>[ \t]+)max_steps = cfg\.max_steps[ \t]*$"
    r"(?=(?:\n(?!    def )[^\n]*)*\n[ \t]+l1loss = l1_loss\([^\n]*\)\.mean\(\))",
    "l1_loss = self.phases.pixel_loss",
    "after",
    "max_steps = cfg.max_steps in train() with l1loss = l1_loss(...).mean()",
)
_INRIA = (
    Edit(r"^from scene import [^\n(]*$", IMPORT, "after", "from scene import ..."),
    Edit(
        # After restore(), which makes a new optimizer.
        r"^(?P<indent>[ \t]+)bg_color = [^\n]*$",
        "phases, gaussians.optimizer = PhaseScheduler.install(gaussians.optimizer, opt.iterations)",
        "before",
        "bg_color = ... in training()",
    ),
    Edit(
        r"^(?P<indent>[ \t]+)Ll1 = l1_loss\((?P<pair>\w+, \w+)\)[ \t]*$",
        lambda match: f"Ll1 = phases.pixel_loss({match['pair']})",
        "instead",
        "Ll1 = l1_loss(...)",
    ),
    Edit(_BACKWARD, "phases.observe(loss)", "after", "loss.backward()"),
)
HOSTS = (
    Host("gsplat simple_trainer.py", (*_GSPLAT_START, _GSPLAT_L1, _GSPLAT_OBSERVE)),
    Host("gsplat simple_trainer.py, 1.6", (*_GSPLAT_START, _GSPLAT_L1_BY_NAME, _GSPLAT_OBSERVE)),
    Host("INRIA gaussian-splatting or 3dgs-mcmc train.py", _INRIA),
)


def edited(text: str) -> tuple[Host, str]:
    """The trainer that `text` is, and its text with our lines.

    Raises:
        ValueError: no known trainer, or the lines are there already.
    """
    if re.search(r"^\s*(from|import) opt3dgs_optim\b", text, re.MULTILINE):
        raise ValueError("it imports opt3dgs_optim already; start from the trainer's own file")
    newline = "\r\n" if "\r\n" in text else "\n"
    plain = text.replace("\r\n", "\n")
    missing = {}
    for host in HOSTS:
        found = [list(re.finditer(e.anchor, plain, re.MULTILINE)) for e in host.edits]
        if all(len(matches) == 1 for matches in found):
            return host, _apply(plain, host, [m[0] for m in found]).replace("\n", newline)
        missing[host.name] = [
            f"{edit.what} ({len(matches)} times)"
            for edit, matches in zip(host.edits, found, strict=True)
            if len(matches) != 1
        ]
    name = min(missing, key=lambda host: len(missing[host]))
    raise ValueError(
        f"it is no trainer known here ({', '.join(host.name for host in HOSTS)}); nearest is "
        f"{name}, which must have exactly once: {'; '.join(missing[name])}"
    )


def _apply(text: str, host: Host, matches: Sequence[re.Match[str]]) -> str:
    pairs = sorted(zip(matches, host.edits, strict=True), key=lambda pair: pair[0].start())
    for match, edit in reversed(pairs):
        line = edit.line if isinstance(edit.line, str) else edit.line(match)
        line = match.groupdict().get("indent", "") + line
        before, after = text[: match.start()], text[match.end() :]
        new = {
            "after": f"{match[0]}\n{line}",
            "before": f"{line}\n{match[0]}",
            "instead": line,
        }[edit.where]
        text = before + new + after
    return text


def diff(path: Path) -> tuple[Host, str, str]:
    """(trainer, unified diff, new text) for the file at `path`; ValueError as `edited`."""
    old = _read(path)
    host, new = edited(old)
    lines = difflib.unified_diff(
        old.splitlines(keepends=True), new.splitlines(keepends=True), str(path), str(path), n=1
    )
    return host, "".join(lines), new


def write(path: Path) -> Path:
    """Apply the lines to the file at `path`; returns the backup's path.

    Raises:
        ValueError: as `edited`, or there is a backup already.
    """
    backup = path.with_name(path.name + ".orig")
    if backup.exists():
        raise ValueError(f"its backup {backup} exists already; remove it or move it away")
    _, _, new = diff(path)
    backup.write_bytes(path.read_bytes())
    path.write_bytes(new.encode())
    return backup


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"it cannot be read: {error}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0 where the file was recognised, else 1."""
    parser = argparse.ArgumentParser("python -m opt3dgs_optim.hosts", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("diff", help="print the changed lines for a trainer's file")
    command.add_argument("path", type=Path, help="simple_trainer.py or train.py")
    command.add_argument("--write", action="store_true", help="apply them, keep PATH.orig")
    options = parser.parse_args(arguments)
    try:
        host, lines, _ = diff(options.path)
        backup = write(options.path) if options.write else None
    except ValueError as error:
        print(f"opt3dgs_optim.hosts: {options.path}: {error}", file=sys.stderr)
        return 1
    print(lines, end="")
    if backup is not None:
        print(f"{host.name}: {options.path} changed, the old file is {backup}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
