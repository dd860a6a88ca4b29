"""Add LPIPS to the study's records: python examples/study/perceptual.py --runs DIR --scenes DIR
--tool FILE.py --weights DIR

The tool is a Python file with `load(weights_dir, net)` and `lpips(model, a, b)` for images
[B, 3, H, W] in -1..1: a thin wrapper of any implementation (the `lpips` package needs torchvision
and a download). AlexNet, inputs in -1..1, the mean over the test views.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from splatting.scenes import Scene, load_scene
from torch import Tensor
from tqdm import tqdm

NET = "alex"


def load_tool(path: Path) -> Any:
    """The file as a module; ValueError unless it has both functions."""
    spec = importlib.util.spec_from_file_location("perceptual_tool", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"--tool {path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    missing = [name for name in ("load", "lpips") if not hasattr(module, name)]
    if missing:
        raise ValueError(f"--tool {path}: lacks {', '.join(missing)}")
    return module


def _as_input(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None] * 2.0 - 1.0


def mean_lpips(tool: Any, model: Any, scene: Scene, renders: Sequence[np.ndarray]) -> float:
    """Mean over the test views.

    Args:
        renders: [H, W, 3] uint8 each, in the order of `scene.test`.
    """
    values = [
        float(tool.lpips(model, _as_input(torch.from_numpy(render) / 255.0), _as_input(view.image)))
        for view, render in zip(scene.test, renders, strict=True)
    ]
    return sum(values) / len(values)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name in ("runs", "scenes", "tool", "weights"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)

    @cache
    def scene_of(name: str) -> Scene:
        return load_scene(name if name == "embedded" else args.scenes / name)

    try:
        tool = load_tool(args.tool)
        model = tool.load(args.weights, NET)
        for path in tqdm(sorted(args.runs.rglob("record.json")), unit="training"):
            record = json.loads(path.read_text(encoding="utf-8"))
            if not record.get("finished") or "lpips" in record:
                continue
            with np.load(path.with_name("renders.npz")) as file:
                renders = [file[name] for name in file.files]
            record["lpips"] = round(mean_lpips(tool, model, scene_of(record["scene"]), renders), 5)
            partial = path.with_suffix(".partial")
            partial.write_text(json.dumps(record), encoding="utf-8")
            os.replace(partial, path)
    except (OSError, ValueError) as error:
        print(f"perceptual: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
