"""`opt3dgs lines NAME --iterations N`: a trainer's whole schedule in N iterations.

The pages have the trainers' stock numbers. Where OPT3DGS_TRAINERS names the sources, the trainers'
own parsers and configuration classes are asked whether they are right, and take what is printed.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib.util
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
from trials import TRAINERS as SOURCES
from trials import Trial, copy_edited, missing, num_saved, run

from opt3dgs_optim.hosts import lines
from opt3dgs_optim.hosts.schedules import schedule, shortened
from opt3dgs_optim.hosts.trainers import TRAINERS

STOCK = {name: text for name, one in TRAINERS.items() if (text := schedule(one)) is not None}
MANY = [*range(300, 3000, 10), 3330, 7010, 7500, 9990, 10_000, 14_990, 15_000, 29_990, 30_000]
INRIA = {  # name: folder and script
    "inria": ("gaussian-splatting", "train.py"), "3dgs-mcmc": ("3dgs-mcmc", "train.py"),
    "2dgs": ("2d-gaussian-splatting", "train.py"), "taming-3dgs": ("taming-3dgs", "train.py"),
    "mini-splatting": ("mini-splatting", "ms/train.py"),
    "mini-splatting-d": ("mini-splatting", "ms_d/train.py"),
}  # fmt: skip
hosts = pytest.mark.hosts


def commands(name: str, iterations: int | None = None) -> list[list[str]]:
    """The words of each command; of the page's, where no number of iterations is given."""
    text = STOCK[name] if iterations is None else shortened(STOCK[name], iterations)
    found = [each.partition("\n")[2] for each in text.split("\n\n") if "# in " not in each]
    return [shlex.split(each.replace("\\\n", " ")) for each in found]


def options(words: list[str]) -> dict[str, Any]:
    """The options of a command that are numbers or lists of them."""
    found: dict[str, Any] = {}
    for word in re.findall(
        r"(?:--)?([\w.]+)[ =](\[[\d,]+\]|[\d.]+(?: [\d.]+)*)(?= |$)", " ".join(words)
    ):
        numbers = [ast.literal_eval(each) for each in re.split(r"[ ,]", word[1].strip("[]"))]
        is_list = len(numbers) > 1 or word[0].startswith(("test_", "save_", "checkpoint_"))
        found[word[0]] = numbers if is_list else numbers[0]
    return found


def edits(name: str, iterations: int) -> Iterator[tuple[str, str]]:
    """Lines of the trainer's file, and what takes their place."""
    for group in shortened(STOCK[name], iterations).split("\n\n"):
        found = re.fullmatch(r"# in the place of `(.+)`, indented by (\d+) like it\n(.+)", group)
        if found:
            yield " " * int(found[2]) + found[1], " " * int(found[2]) + found[3]


# -- what is printed -------------------------------------------------------------------------------


def test_trainers_with_a_schedule() -> None:
    assert set(TRAINERS) - set(STOCK) == {"grendel-gs", "faster-gs", "citygaussian", "drivestudio"}


@pytest.mark.parametrize("name", STOCK)
def test_the_stock_length_is_the_stock_schedule(name: str) -> None:
    again = shortened(STOCK[name], 30_000)
    assert re.sub(r"the place of `.+`, ind", r"train.py, ind", again) == re.sub(
        r"in \S+train\.py", "in train.py", STOCK[name]
    ).replace(" 1.0", " 1.00001").replace(" 0.65", " 0.65001")


def test_a_third_of_inrias(capsys: pytest.CaptureFixture[str]) -> None:
    """As one reads it: starts and intervals rounded up, ends down."""
    assert lines.main(["inria", "--iterations", "10000"]) == 0
    printed = capsys.readouterr().out
    assert "phases = PhaseScheduler(opt.iterations - 1" in printed
    assert (
        """# 10,000 iterations
python train.py -s SCENE --iterations 10000 --position_lr_max_steps 10000 \\
  --densify_from_iter 167 --densify_until_iter 5000 --densification_interval 34 --opacity_reset_interval 1000 \\
  --test_iterations 2334 10000 --save_iterations 2334 10000

# in the place of `if iteration % 1000 == 0:`, indented by 8 like it
if iteration % 334 == 0:

"""  # noqa: E501
        in printed
    )


def test_what_counts_no_iterations_stays() -> None:
    assert "--opacity_cull 5e-3" in shortened(STOCK["2dgs"], 10_000)


@pytest.mark.parametrize("name", STOCK)
def test_no_refinement_and_no_reset_is_added(name: str) -> None:
    """INRIA's form of it, and gsplat's, which rounds down by itself."""
    for n in MANY if name != "taming-3dgs" else range(300, 30_001, 300):
        for words in zip(commands(name, n), commands(name), strict=True):
            found, stock = map(options, words)
            assert all(each > 0 for each in found.values() if isinstance(each, int)), (n, found)
            assert list(found) == list(stock)
            if "steps_scaler" in found:
                factor = found["steps_scaler"]
                assert int(30_000 * factor) == n
                assert int(15_000 * factor) == n // 2
                assert int(3_000 * factor) == n // 10
                assert int(100 * factor) >= 1
            if "opacity_reset_interval" in found:
                resets = events(found, found["opacity_reset_interval"], 0)
                assert resets == 4 == events(stock, stock["opacity_reset_interval"], 0)
            if "densification_interval" in found:
                assert refinements(found) <= refinements(stock), n
            if name == "taming-3dgs":  # its list of budgets
                span = found["densify_until_iter"] - found["densify_from_iter"]
                assert refinements(found) < span // found["densification_interval"], n


def events(found: dict[str, Any], every: int, start: int) -> int:
    """Iterations before densification ends, and after its start, that the interval divides."""
    return sum(start < at for at in range(every, found["densify_until_iter"], every))


def refinements(found: dict[str, Any]) -> int:
    return events(found, found["densification_interval"], found["densify_from_iter"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["drivestudio", "--iterations", "10000"], "the schedule of drivestudio was not read"),
        (["inria", "--iterations", "290"], "a multiple of 10 is needed, 300 or more"),
        (["inria", "--iterations", "1005"], "a multiple of 10 is needed"),
        (["taming-3dgs", "--iterations", "10000"], "a multiple of 300 is needed"),
        (["train.py", "--iterations", "1000"], "--open-end need the name of a trainer"),
        (["--iterations", "1000"], "--open-end need the name of a trainer"),
    ],
)
def test_what_is_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        lines.main(words)
    assert message in " ".join(capsys.readouterr().err.split())


# -- the trainers' own parsers ---------------------------------------------------------------------


def source(*parts: str) -> Path:
    path = SOURCES.joinpath(*parts)
    if not path.is_file():
        pytest.skip(f"no {path}: put its sources there, set OPT3DGS_TRAINERS")
    return path


def parser_of(script: Path, root: Path) -> argparse.ArgumentParser:
    """The parser that a script of INRIA's kind makes, by its own statements."""
    path = root / "arguments" / "__init__.py"
    spec = importlib.util.spec_from_file_location("arguments_of_a_trainer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    names = {**vars(module), "ArgumentParser": argparse.ArgumentParser}
    main = ast.parse(script.read_text(encoding="utf-8")).body[-1]
    assert isinstance(main, ast.If)
    making = main.body[: next(i for i, s in enumerate(main.body) if "parse_args" in ast.unparse(s))]
    exec(compile(ast.Module(making, []), str(script), "exec"), names)
    return names["parser"]


@hosts
@pytest.mark.parametrize("name", INRIA)
def test_inrias_parsers(name: str) -> None:
    folder, script = INRIA[name]
    path = source(folder, script)
    parser = parser_of(path, SOURCES / folder)
    for words in commands(name):
        for option, number in options(words).items():
            assert parser.get_default(option) == number, option
    (words,) = commands(name, 9_000)
    assert words[:2] == ["python", script]
    taken = vars(parser.parse_args([w.replace("GAUSSIANS", "5") for w in words[2:]]))
    assert options(words).items() <= taken.items()
    code = [line.rstrip() for line in path.read_text(encoding="utf-8").split("\n")]
    for old, _ in edits(name, 9_000):
        assert code.count(old) == 1, old


GSPLAT = """
import dataclasses, json, runpy, sys
from pathlib import Path
import on_cpu
script = Path(sys.argv[1])
on_cpu.prepare(script)
import tyro
names = runpy.run_path(str(script), run_name="asked")
kind = sys.argv[2] if sys.argv[2] in ("mcmc", "default") else None
strategy = {"mcmc": "MCMCStrategy", "default": "DefaultStrategy"}.get(kind)
start = names["Config"](**({} if kind is None else {"strategy": names[strategy]()}))
found = tyro.cli(names["Config"], default=start, args=sys.argv[3 if kind else 2:])
found.adjust_steps(found.steps_scaler)
print("made:", json.dumps(dataclasses.asdict(found), default=str))
"""


@hosts
@pytest.mark.parametrize("version", ["main", "1.5.3", "1.4.0"])
@pytest.mark.parametrize("name", ["gsplat", "gsplat-2dgs"])
def test_gsplats_configuration(name: str, version: str, tmp_path: Path) -> None:
    for words in commands(name, 10_000):
        if (why := missing(Trial(f"gsplat-{version}", script=words[1]))) is not None:
            pytest.skip(why)
        script = SOURCES / f"gsplat-{version}" / words[1]
        code = [sys.executable, "-c", GSPLAT, str(script), *words[2:]]
        env = {"PYTHONPATH": ":".join(sys.path), "PATH": "/usr/bin:/bin"}
        done = subprocess.run(
            code, cwd=tmp_path, env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-3000:]
        made = json.loads(done.stdout.partition("made: ")[2].splitlines()[0])
        made |= made.get("strategy", {})
        assert made["max_steps"] == made["eval_steps"][-1] == made["save_steps"][-1] == 10_000
        assert made["sh_degree_interval"] == 333
        assert (made["refine_start_iter"], made["refine_every"]) == (166, 33)
        if words[2] == "mcmc":
            assert made["refine_stop_iter"] == 8_333
        else:
            assert (made["refine_stop_iter"], made["reset_every"]) == (5_000, 1_000)
        if name == "gsplat-2dgs":
            assert (made["normal_start_iter"], made["dist_start_iter"]) == (2_334, 1_000)


def configuration(path: Path, name: str) -> Any:
    """A dataclass of a trainer, made from its own statements alone."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    (found,) = [n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name]
    found.bases = []
    found.body = [n for n in found.body if not isinstance(n, ast.FunctionDef)]
    names: dict[str, Any] = {
        **{"dataclass": dataclasses.dataclass, "field": dataclasses.field, "Literal": Literal},
        **{"List": list, "Tuple": tuple, "Type": type, "Any": Any, "__name__": "typing"},
    }
    future = ast.parse("from __future__ import annotations").body
    exec(compile(ast.Module([*future, found], []), str(path), "exec"), names)
    return names[name]


def defaults(path: Path, name: str) -> dict[str, Any]:
    """What a configuration class has by default."""
    made = configuration(path, name)
    found = {}
    for each in dataclasses.fields(made):
        if each.default is not dataclasses.MISSING:
            found[each.name] = each.default
        elif each.default_factory is not dataclasses.MISSING and each.name == "means_lr_scheduler":
            found |= {
                f"means_lr_scheduler.{k}": v for k, v in each.default_factory()["init_args"].items()
            }
    return found


@hosts
@pytest.mark.parametrize("folder", ["nerfstudio", "nerfstudio-1.1.5"])
def test_nerfstudios_configuration(folder: str) -> None:
    model = defaults(source(folder, "nerfstudio/models/splatfacto.py"), "SplatfactoModelConfig")
    trainer = defaults(source(folder, "nerfstudio/engine/trainer.py"), "TrainerConfig")
    methods = source(folder, "nerfstudio/configs/method_configs.py").read_text(encoding="utf-8")
    for words in commands("nerfstudio"):
        _, found, method = methods.partition(f'_configs["{words[1].removesuffix("-opt3dgs")}"] = ')
        if not found and folder == "nerfstudio-1.1.5":  # it has no splatfacto-mcmc
            continue
        method = method.split("\nmethod_configs[")[0]
        for option, number in options(words).items():
            last = option.rpartition(".")[2]
            if option.startswith("pipeline.model."):
                own = re.search(rf"\b{last}=(\d+)", method)
                assert number == (int(own[1]) if own else model[last]), option
            elif option.startswith("optimizers.means."):
                means = method.split('"means": {')[1].split('"features_dc"')[0]
                assert f"{last}={number}" in means
            else:
                assert last in trainer
                assert f"{last}={number}" in method


@hosts
def test_fvdbs_configuration() -> None:
    folder = "fvdb_reality_capture/radiance_fields"
    path = source("fvdb-0.6.0", f"{folder}/gaussian_splat_reconstruction.py")
    stock = defaults(path, "GaussianSplatReconstructionConfig")
    for words in commands("fvdb"):
        for option, number in options(words).items():
            assert stock[option.removeprefix("cfg.")] == number, option


@hosts
def test_lightnings_configuration() -> None:
    at = "gaussian-splatting-lightning"
    density = {
        15_000: defaults(
            source(at, "internal/density_controllers/vanilla_density_controller.py"),
            "VanillaDensityController",
        ),
        25_000: defaults(
            source(at, "internal/density_controllers/mcmc_density_controller.py"),
            "MCMCDensityController",
        ),
    }
    rates = defaults(source(at, "internal/models/vanilla_gaussian.py"), "OptimizationConfig")
    said = source(at, "internal/cli.py").read_text(encoding="utf-8")
    assert '"--save_iterations", type=List[int], default=[7_000, 30_000]' in said
    assert '"--max_steps", ' in said
    for words in commands("lightning"):
        found = options(words)
        kind = density[found["model.density.densify_until_iter"]]
        for option, number in found.items():
            if option.startswith("model.density."):
                assert kind[option.removeprefix("model.density.")] == number, option
            elif option.startswith("model."):
                assert rates[option.removeprefix("model.gaussian.optimization.")] == number, option


@hosts
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # hydra's own
def test_3dgruts_configuration() -> None:
    hydra = pytest.importorskip("hydra", reason="3dgrut needs hydra-core: pip install it")
    omegaconf = pytest.importorskip("omegaconf")
    for name, made in (("int_list", lambda each: each), ("div", lambda a, b: a / b)):
        omegaconf.OmegaConf.register_new_resolver(name, made, replace=True)
    folder = str(source("3dgrut", "configs/base_gs.yaml").parent)
    both = zip(commands("3dgrut"), commands("3dgrut", 10_000), strict=True)
    with hydra.initialize_config_dir(folder, version_base=None):
        for stock, short in both:
            assert stock[:3] == ["python", "train.py", "--config-name"]
            base = hydra.compose(stock[3].removesuffix(".yaml"))
            changed = hydra.compose(short[3].removesuffix(".yaml"), overrides=short[4:])
            for config, words in ((base, stock), (changed, short)):
                for option, number in options(words).items():
                    assert omegaconf.OmegaConf.select(config, option) == number, option


# -- and run ---------------------------------------------------------------------------------------

SHORTEST = 300
RUNS = {
    "inria": Trial("gaussian-splatting", "--disable_viewer"),
    "3dgs-mcmc": Trial("3dgs-mcmc", "--init_type sfm"),
    "2dgs": Trial("2d-gaussian-splatting"),
    "gsplat mcmc": Trial(
        "gsplat-main", "--strategy.cap_max 2500", script="examples/simple_trainer.py"
    ),
    "gsplat default": Trial("gsplat-main", script="examples/simple_trainer.py"),
}


@hosts
@pytest.mark.parametrize("name", RUNS)
def test_what_is_printed_is_pasted_and_runs_to_its_end(
    name: str, scene: Path, tmp_path: Path
) -> None:
    """The real script with the three lines and the replaced ones, and the printed command."""
    trial, (name, _, kind) = RUNS[name], name.partition(" ")
    if (why := missing(trial)) is not None:
        pytest.skip(why)
    folder, out = tmp_path / "edited" / trial.trainer, tmp_path / "out"
    copy_edited(trial, folder)
    path = folder / trial.script
    text = path.read_text(encoding="utf-8")
    for old, new in edits(name, SHORTEST):
        assert len(re.findall(rf"^{re.escape(old)} *$", text, re.M)) == 1
        text = re.sub(rf"^{re.escape(old)} *$", lambda _, new=new: new, text, flags=re.M)
    path.write_text(text, encoding="utf-8")
    (words,) = (each for each in commands(name, SHORTEST) if kind in ("", each[2]))
    given = {"SCENE": str(scene), "GAUSSIANS": "2500"}
    own = ["-m", str(out), "--images", "images_jpg", "--eval"]
    if trial.gsplat:
        own = [
            "--result_dir",
            str(out),
            "--data_factor",
            "4",
            "--disable_viewer",
            "--disable_video",
        ]
    done = run(path, [given.get(w, w) for w in words[2:]] + own + trial.options.split(), out)
    assert done.code == 0, done.output[-3000:]
    steps = SHORTEST if trial.gsplat else SHORTEST - 1
    assert f"opt3dgs_optim: {steps} iterations" in done.output
    assert "no mean" not in done.output
    assert done.psnr is not None
    saved = [f"*/ckpt_{SHORTEST - 1}_rank0.pt", f"*/iteration_{SHORTEST}/point_cloud.ply"]
    (path,) = out.glob(saved[not trial.gsplat])
    assert num_saved(path) > 1000
