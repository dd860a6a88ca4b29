"""Whether a scene's poses fit its photos, and poses anew: register.py SCENE [OUT]

    pip install pycolmap
    python examples/studies/scenes/register.py SCENE          # says which photos do not fit
    python examples/studies/scenes/register.py SCENE OUT      # the same photos, posed anew, in OUT

Poses that were found by matching each photo with its neighbours alone may fall into parts that do
not fit together: an orbit that comes back sees the scene a second time, at another place. No
training can fit that, though every photo may fit its own points. Here photos are matched with their
neighbours, and every third one with every other third one, and all are posed at once, so that
orbits close.

pycolmap and Pillow in one process corrupted the heap (seen twice), so that nothing else reads
pictures here. One thread is the default, since mapping with several is not the same twice.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

NEIGHBOURS, STRIDE = 12, 3  # photos that follow, and every so manieth other
PARTS = 14  # of the photos, each of which is to look at the same thing
MAX_RATIO = 2.0  # of a photo's median reprojection error to the median over all photos


def load_pycolmap() -> Any:
    """The library, or SystemExit that says how to get it."""
    try:
        import pycolmap  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise SystemExit("register: needs pycolmap; pip install pycolmap") from None
    return pycolmap


def median_errors(reconstruction: Any) -> dict[str, float]:
    """Photo -> median reprojection error of the points that it sees, pixels; inf: it sees none."""
    found = {}
    for image in reconstruction.images.values():
        seen = [p for p in image.points2D if p.has_point3D()]
        points = [reconstruction.points3D[p.point3D_id].xyz for p in seen]
        where = [image.project_point(xyz) for xyz in points]
        gaps = [
            np.inf if at is None else float(np.linalg.norm(at - p.xy))
            for at, p in zip(where, seen, strict=True)
        ]
        found[image.name] = float(np.median(gaps)) if gaps else float("inf")
    return dict(sorted(found.items()))


def that_do_not_fit(errors: dict[str, float]) -> list[str]:
    """The photos whose error is more than `MAX_RATIO` times the median over all photos."""
    usual = float(np.median(list(errors.values())))
    return [name for name, error in errors.items() if error > MAX_RATIO * usual]


def spread_of_looks(reconstruction: Any) -> float:
    """How far apart the points are that parts of the photos look at, over the cameras' distance.

    In the order of their names. What a part looks at is the point next to the optical axes of its
    cameras. Around one object it is far below 1, also where every photo fits its own points: an
    orbit that comes back to a second copy of the object has two such points.
    """
    images = sorted(reconstruction.images.values(), key=lambda image: image.name)
    found = []
    for part in np.array_split(np.arange(len(images)), min(PARTS, len(images) // 2)):
        centres = np.array([images[i].projection_center() for i in part])
        axes = np.array([images[i].viewing_direction() for i in part])
        across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [n, 3, 3], off each axis
        moved = (across @ centres[:, :, None]).sum(0)
        point = np.linalg.lstsq(across.sum(0), moved, rcond=None)[0][:, 0]
        found.append((point, np.linalg.norm(centres - point, axis=1).mean()))
    points = np.array([point for point, _ in found])
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    return float(gaps.max() / np.median([distance for _, distance in found]))


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Which photos are matched: those that follow, and every `STRIDE`th with every other."""
    near = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + NEIGHBOURS))}
    far = {(i, j) for i in range(0, count, STRIDE) for j in range(i + STRIDE, count, STRIDE)}
    return sorted(near | far)


def register(scene: Path, out: Path, threads: int) -> Any:
    """Pose a scene's photos anew; return the largest reconstruction, which is in `out`, too.

    All photos have one pinhole camera, and begin with the focal lengths of the scene's first one.
    """
    library, images = load_pycolmap(), scene / "images"
    names = sorted(path.name for path in images.iterdir())
    camera = next(iter(library.Reconstruction(scene / "sparse" / "0").cameras.values()))
    out.mkdir(parents=True)
    database, listed = out / "database.db", out / "pairs.txt"
    reader = library.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ",".join(map(str, camera.params))
    extraction = library.FeatureExtractionOptions()
    matching = library.FeatureMatchingOptions()
    for options in (extraction, matching):
        options.num_threads, options.use_gpu = threads, False
    one = library.CameraMode.SINGLE
    library.extract_features(
        database, images, camera_mode=one, reader_options=reader, extraction_options=extraction
    )
    pairs = pairs_of(len(names))
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    pairing = library.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    library.match_image_pairs(database, matching_options=matching, pairing_options=pairing)
    mapping, models = library.GlobalPipelineOptions(), out / "models"
    mapping.num_threads, mapping.random_seed = threads, 0
    models.mkdir()
    # All poses at once: photo by photo, bonsai's orbit came back to a second table.
    found = library.global_mapping(database, images, models, options=mapping)
    if not found:
        raise SystemExit(f"register: {scene}: no two photos could be posed together")
    largest = max(found.values(), key=lambda model: model.num_reg_images())
    (out / "sparse" / "0").mkdir(parents=True)
    largest.write(out / "sparse" / "0")
    for folder in sorted(scene.glob("images*")):
        (out / folder.name).symlink_to(folder.resolve(), target_is_directory=True)
    return largest


def report(reconstruction: Any) -> str:
    """How many photos are posed, how well they fit, and which do not."""
    errors = median_errors(reconstruction)
    bad = that_do_not_fit(errors)
    usual = float(np.median(list(errors.values())))
    lines = [f"{len(errors)} photos, median reprojection error {usual:.2f} pixels"]
    lines += [f"{name}: {errors[name]:.2f} pixels" for name in bad]
    lines.append(f"{len(bad)} photos have more than {MAX_RATIO:g} times that")
    spread = spread_of_looks(reconstruction)
    lines.append(f"parts of them look at points {spread:.2f} of the cameras' distance apart")
    lines.append("(around one object that is far below 1; seen from one side it says nothing)")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("scene", type=Path, help="folder with images/ and sparse/0/, one pinhole camera")
    add("out", type=Path, nargs="?", help="a new folder for the scene with other poses")
    add("--threads", type=int, default=1, help="of matching and mapping")
    args = parser.parse_args(arguments)
    if args.out is None:
        model = load_pycolmap().Reconstruction(args.scene / "sparse" / "0")
    elif args.out.exists():
        raise SystemExit(f"register: {args.out} is there already; name a new folder")
    else:
        model = register(args.scene, args.out, args.threads)
    print(report(model))
    return 0


if __name__ == "__main__":
    sys.exit(main())
