"""Whether results can be written where they are to go: asked before the work, not after."""

from __future__ import annotations

import tempfile
from pathlib import Path


def check_folder(folder: Path) -> None:
    """Make the folder; OSError, with the path, where it cannot be written to."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass


def check_file(path: Path) -> None:
    """Make the file's folder; OSError, with the path, where the file cannot be written."""
    check_folder(path.parent)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: a folder, but a file is needed")
