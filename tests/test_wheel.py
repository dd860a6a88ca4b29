"""Wheel and sdist: small, complete, and working where they are all there is of the project."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).parent.parent
LAST = re.findall(r'^fallback-version = "(.+?)"', (ROOT / "pyproject.toml").read_text(), re.M)[0]
MOST_BYTES = 300_000  # of the wheel: the package is text, and a picture or a folder more would show
SMOKE = """
import sys, torch
before = set(sys.modules)  # torch itself imports tqdm where there is one
import opt3dgs_optim
from opt3dgs_optim import LQNAdam, PhaseScheduler
assert {place!r} in opt3dgs_optim.__file__, opt3dgs_optim.__file__
x = torch.nn.Parameter(torch.ones(300, 3))
optimizer = LQNAdam([x], lr=0.1)
for _ in range(5):
    x.grad = x.detach() * torch.tensor([1.0, 10.0, 100.0])
    optimizer.step()
assert float(optimizer.accepted_share) > 0.9

widths = {{"means": 3, "scales": 3, "quats": 4}}
splats = {{name: torch.nn.Parameter(torch.ones(50, n)) for name, n in widths.items()}}
adams = {{k: torch.optim.Adam([dict(params=[p], lr=0.01, name=k)]) for k, p in splats.items()}}
phases = PhaseScheduler(60)
phases.upgrade(adams)
losses = []
for _ in range(60):
    loss = sum(each.square().mean() for each in splats.values())
    loss.backward()
    for optimizer in adams.values():
        optimizer.step()
        optimizer.zero_grad()
    losses.append(loss.item())
assert losses[-1] < losses[0], losses
assert not {{"matplotlib", "numba", "tqdm", "gsplat"}} & (set(sys.modules) - before)
print("trained")
"""

pytestmark = [
    pytest.mark.skipif(
        any(
            importlib.util.find_spec(name) is None
            for name in ("hatchling", "hatch_vcs", "hatch_fancy_pypi_readme")
        ),
        reason="hatchling or a plugin of it is not installed",
    ),
    pytest.mark.processes,
]


def build(root: Path, kind: str, folder: Path) -> Path:
    """The wheel or the sdist of the project at `root`."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
    return next(folder.glob("*.whl" if kind == "wheel" else "*.tar.gz"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, "wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment with the wheel and, on its path, torch: nothing is downloaded."""
    env = tmp_path_factory.mktemp("env")
    venv.create(env, with_pip=False)
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "-q"]
    subprocess.run([*install, "--target", str(site_of(env)), str(wheel)], check=True)
    (site_of(env) / "torch.pth").write_text(str(Path(torch.__file__).parent.parent) + "\n")
    return env / "bin" / "python"


def site_of(env: Path) -> Path:
    return next((env / "lib").glob("python*")) / "site-packages"


def run(python: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder that has nothing of the project."""
    return subprocess.run(
        [str(python), "-W", "error", *words],
        cwd=folder,
        env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
    )


def version_of(wheel: Path) -> str:
    """What the build has found, which needs not be what is installed here."""
    return wheel.name.split("-")[1]


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_wheel_is_small_and_holds_the_package_alone(wheel: Path) -> None:
    assert wheel.name == f"opt3dgs_optim-{version_of(wheel)}-py3-none-any.whl"
    assert wheel.stat().st_size < MOST_BYTES
    names = set(contents(wheel))
    for name in ("py.typed", "__main__.py", "step.py", "cuda/two_loop.cu", "runs/report.py"):
        assert f"opt3dgs_optim/{name}" in names
    tops = {name.split("/")[0] for name in names}
    assert tops == {"opt3dgs_optim", f"opt3dgs_optim-{version_of(wheel)}.dist-info"}


def test_wheel_needs_torch_and_numpy_alone(wheel: Path) -> None:
    lines = metadata_of(wheel).splitlines()
    needed = [
        line for line in lines if line.startswith("Requires-Dist:") and "extra ==" not in line
    ]
    assert sorted(line.split()[1].split(">")[0] for line in needed) == ["numpy", "torch"]
    extras = {line.split()[1] for line in lines if line.startswith("Provides-Extra:")}
    assert extras == {"cuda", "cuda12", "report", "examples", "test", "dev"}
    assert f"Version: {version_of(wheel)}" in lines
    for field in ("Author:", "License-Expression:", "Requires-Python:", "Classifier: Environment"):
        assert any(line.startswith(field) for line in lines), field


def metadata_of(wheel: Path) -> str:
    (found,) = (text for name, text in contents(wheel).items() if name.endswith("/METADATA"))
    return found.decode()


def test_an_extra_of_linux_keeps_its_marker(wheel: Path) -> None:
    """Else the test command asks macOS for Triton, which has none."""
    (triton,) = [line for line in metadata_of(wheel).splitlines() if "Dist: triton" in line]
    assert "platform_system == 'Linux'" in triton


def test_what_an_index_shows_leads_nowhere_wrong(wheel: Path) -> None:
    """It has README.md alone: no relative link, no relative picture, no marker of ours."""
    text = metadata_of(wheel).partition("\n\n")[2]
    assert text.startswith("# opt3dgs_optim\n")
    assert "phases.upgrade(optimizers)" in text
    assert re.findall(r"\]\((?!https?:)[^)]*\)", text) == []
    assert "![" not in text
    assert "<!--" not in text
    assert "Project-URL: Paper" in metadata_of(wheel)


def test_the_command_is_installed_and_knows_its_version(
    installed: Path, wheel: Path, tmp_path: Path
) -> None:
    (entry,) = site_of(installed.parent.parent).glob("*.dist-info/entry_points.txt")
    assert "[console_scripts]\nopt3dgs = opt3dgs_optim.__main__:main\n" in entry.read_text()
    command = "import sys; from opt3dgs_optim.__main__ import main; sys.exit(main(['--version']))"
    assert run(installed, tmp_path, "-c", command).stdout.strip() == version_of(wheel)


@pytest.mark.parametrize(
    ("tags", "later", "expected"),
    [(["v3.4.5"], 0, r"3\.4\.5"), (["v3.4.5"], 1, r"3\.4\.5\+g[0-9a-f]+"), (None, 0, LAST)],
    ids=["a tag", "a commit after it", "no git at all"],
)
def test_version_comes_from_git(
    tags: list[str] | None, later: int, expected: str, tmp_path: Path
) -> None:
    """Never one that the changelog does not have: the last release's, with the commit after it."""
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("src", "docs/hosts"):
        plain = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, tmp_path / name, ignore=plain)
    if tags is not None:
        (tmp_path / ".gitignore").write_text("out/\n__pycache__/\n")
        who = ["-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "commit.gpgsign=false"]
        steps = [["init", "-q"], ["add", "-A"], [*who, "commit", "-qm", "x"]]
        after = [[*who, "commit", "-q", "--allow-empty", "-m", "y"]] * later
        for step in [*steps, *(["tag", tag] for tag in tags), *after]:
            subprocess.run(["git", *step], cwd=tmp_path, check=True)
    assert re.fullmatch(expected, version_of(build(tmp_path, "wheel", tmp_path / "out")))


def test_sdist_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    sdist = build(ROOT, "sdist", tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        safely: Any = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # not in 3.11.2
        archive.extractall(tmp_path / "source", **safely)
    (source,) = (tmp_path / "source").iterdir()
    wanted = ("tests/test_wheel.py", "examples/quickstart.py", "CITATION.cff", "LICENSE", ".ci/run")
    for name in (*wanted, "docs/results/iterations.png"):
        assert (source / name).exists(), name
    assert sdist.stat().st_size < 2_500_000
    again = build(source, "wheel", tmp_path / "again")
    assert again.name == wheel.name
    assert contents(again) == contents(wheel)


def test_wheel_trains_in_an_empty_environment(installed: Path, tmp_path: Path) -> None:
    place = str(site_of(installed.parent.parent))
    done = run(installed, tmp_path, "-c", SMOKE.format(place=place))
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("trained\n")


def test_a_trainers_lines_and_notes_are_in_the_wheel(installed: Path, tmp_path: Path) -> None:
    done = run(installed, tmp_path, "-m", "opt3dgs_optim", "lines", "3dgs-mcmc")
    assert done.returncode == 0, done.stderr
    for said in ("phases = PhaseScheduler(opt.iterations - 1)", "Noise: ", "Resume: "):
        assert said in done.stdout


def test_doctor_finds_the_wheel_in_order(installed: Path, wheel: Path, tmp_path: Path) -> None:
    done = run(installed, tmp_path, "-m", "opt3dgs_optim", "doctor", "--device", "cpu")
    assert done.returncode == 0, done.stdout + done.stderr
    assert version_of(wheel) in done.stdout
