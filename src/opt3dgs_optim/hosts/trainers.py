"""Every known trainer: its file, the lines to insert, and what one should know beside them.

`lines` prints it, `diff` inserts the lines, and the pages of docs/hosts/ repeat it.
"""

from __future__ import annotations

from collections.abc import Mapping

from opt3dgs_optim.hosts.places import Place, Trainer

IMPORT = "from opt3dgs_optim import {names}"
UPGRADE = "phases.upgrade(gaussians.optimizer)"

_HEAD = Place("import torch", (IMPORT,))
_ADC = (
    "The trainer clones, splits and prunes, so that the lines name the preset `DEFAULTS_ADC`. "
    "It was measured in 30,000 iterations; a trial of some hundred loses by it, since its first "
    "steps are long. The default parts are for relocation: here they lost 1.1 dB on plush in "
    "30,000."
)
_BOTH = (
    "The line looks which density control is at work. Relocation has the default parts; clone, "
    "split and prune has the preset `DEFAULTS_ADC`."
)
_MASKED = (
    "an Adam with a mask keeps its own step, which has no bias correction and is several times "
    "longer than Adam's early on. With clone and split write `parts=DEFAULTS_ADC[1:]`, the preset "
    "without `Annealing`, which makes these steps longer still and loses: see "
    "[sparse Adams](index.md#sparse-adams)."
)

# -- gsplat and what is built on it ----------------------------------------------------------------

_GSPLAT_STEP = (
    "            for optimizer in self.optimizers.values():\n                optimizer.step()\n"
    "                optimizer.zero_grad(set_to_none=True)",
    "            for optimizer in self.optimizers.values():\n"
    "                if cfg.visible_adam:\n                    optimizer.step(visibility_mask)\n"
    "                else:\n                    optimizer.step()",
)
_GSPLAT_SIGNS = (
    "        max_steps = cfg.max_steps",
    "        pbar = tqdm.tqdm(range(init_step, max_steps))",
    "        for step in pbar:",
    "        self.splats, self.optimizers = create_splats_with_optimizers(",
    _GSPLAT_STEP,
)
_GSPLAT_COUNTS = {
    **{".backward(": 1, "break": 0, "continue": 1, "max_steps = ": 2, "self.optimizers = ": 1},
    "self.optimizers[": 1,
}
_GSPLAT_READ = ("main 90d7b4b (2026-08-20)", "v1.5.3 937e299", "v1.4.0 4d3a3b6")
_GSPLAT_PLACES = (
    _HEAD,
    Place(
        "        init_step = 0",
        ("phases = PhaseScheduler(max_steps{parts})", "phases.upgrade(self.optimizers)"),
    ),
)
_GSPLAT_NOTES = {
    "Length": "`--steps_scaler 0.33334` makes 10,000 of gsplat's 30,000 iterations. It scales "
    "`max_steps`, after which the rate of the positions falls, the iterations at which gsplat "
    "evaluates, saves, refines and resets, and the interval at which it adds a degree of "
    "harmonics. `--max_steps 10000` alone leaves all of these but the rate as they are, so that "
    "refinement goes on to the end. So short a training was measured with relocation only.",
    "Resume": "gsplat saves no optimizers, and its script only evaluates a checkpoint. "
    "[Save and resume](gsplat.md#save-and-resume) has the lines that go on with a training; they "
    "go below these.",
}
_GSPLAT = Trainer(
    title="gsplat, simple_trainer.py",
    repository="nerfstudio-project/gsplat",
    file="examples/simple_trainer.py",
    read=_GSPLAT_READ,
    relocates="isinstance(cfg.strategy, MCMCStrategy)",
    places=_GSPLAT_PLACES,
    signs=(*_GSPLAT_SIGNS, "from gsplat.strategy import DefaultStrategy, MCMCStrategy"),
    counts=_GSPLAT_COUNTS,
    variants={"gsplat-mcmc": True, "gsplat-default": False},
    notes={
        "Density control": f"`mcmc` relocates, `default` clones, splits and prunes. {_BOTH}",
        **_GSPLAT_NOTES,
        "Saved": "`ckpts/ckpt_*_rank0.pt` and, with `--save_ply`, `ply/*.ply` of the last "
        "iteration hold the mean of all iterates but the last. With `mcmc` their positions have "
        "the noise of one iteration on top, as without the lines. The PSNR that gsplat prints "
        "last is of one step later. Files of earlier iterations hold plain iterates.",
        "Several ranks": "Each rank has a loss and Gaussians of its own. Give the scheduler "
        "`process_group=torch.distributed.group.WORLD if world_size > 1 else None`.",
        "Options": f"`--visible_adam`: {_MASKED} `--sparse_grad` is refused: torch's SparseAdam is "
        "no Adam. Cameras, appearance networks and grids stay with gsplat's own optimizers. With "
        "`--post_processing ppisp` the main branch freezes the Gaussians at "
        "`cfg.ppisp_controller_activation_num_steps`: give the scheduler that number, which "
        "`steps_scaler` does not scale.",
    },
)
_GSPLAT_2DGS = Trainer(
    title="gsplat, simple_trainer_2dgs.py",
    repository="nerfstudio-project/gsplat",
    file="examples/simple_trainer_2dgs.py",
    read=_GSPLAT_READ,
    relocates=False,
    places=_GSPLAT_PLACES,
    signs=(*_GSPLAT_SIGNS, "from gsplat.strategy import DefaultStrategy"),
    counts=_GSPLAT_COUNTS,
    notes={
        "Density control": _ADC,
        "Flat Gaussians": "`DEFAULTS_ADC` takes them as they are. Add no `OwnFrame` to it, which "
        "makes steps by sizes: the Gaussians have three scales, and nothing trains the third, "
        "which the renderer never reads.",
        **_GSPLAT_NOTES,
        "Saved": "`ckpts/ckpt_*.pt` of the last iteration is written after its step, and holds the "
        "mean.",
    },
)

# -- INRIA's trainer and what derives from it ------------------------------------------------------

_LOOP = "    for iteration in range(first_iter, opt.iterations + 1):"
_STEP = (
    "            if iteration < opt.iterations:\n                gaussians.optimizer.step()\n"
    "                gaussians.optimizer.zero_grad(set_to_none = True)"
)
_INRIA_STEP = (
    "            if iteration < opt.iterations:\n"
    "                gaussians.exposure_optimizer.step()"
)
_INRIA_RESUME = (
    "`capture()` saves the optimizer, and with it the place in the schedule. A checkpoint of the "
    "unchanged trainer knows none, and its Adam has counted fewer steps than iterations: below the "
    "lines write `phases.observe(iteration=first_iter - 1)`. These checkpoints hold a number of "
    "numpy's type, which PyTorch 2.6 and newer load with TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD=1 only."
)
_INRIA_TOTAL = (
    "The trainer makes no step in its last iteration: hence `opt.iterations - 1`, and what it "
    "saves in that iteration is the mean."
)


def _inria(
    title: str,
    repository: str,
    read: str | tuple[str, ...],
    *,
    file: str = "train.py",
    relocates: bool = False,
    step: str | tuple[str, ...] = _STEP,
    upgrade: str = UPGRADE,
    again: tuple[Place, ...] = (),
    counts: Mapping[str, int | tuple[int, ...]] | None = None,
    notes: dict[str, str] | None = None,
) -> Trainer:
    """A trainer with INRIA's loop."""
    total = f"phases = PhaseScheduler(opt.iterations - 1{'{parts}'})"
    return Trainer(
        title=title,
        repository=repository,
        file=file,
        read=(read,) if isinstance(read, str) else read,
        relocates=relocates,
        places=(_HEAD, Place(_LOOP, (total, upgrade), above=True), *again),
        signs=("    first_iter = 0", "    first_iter += 1", step),
        counts={
            **{".backward(": 1, "continue": 0, "break": 1, ".training_setup(": 1, ".restore(": 1},
            **{"opt.iterations =": 0, "relocate_gs(": int(relocates), "shoptimizer": 0},
            **{"gaussians.optimizer.step(": 1, "GaussianModel(": 1, "gaussians.optimizer =": 0},
            **(counts or {}),
        },
        notes={
            "Density control": "The trainer relocates Gaussians, for which the default parts are."
            if relocates
            else _ADC,
            "Length": _INRIA_TOTAL,
            "Resume": _INRIA_RESUME,
            **(notes or {}),
        },
    )


_SETUP = "gaussians.training_setup(opt)"
_AGAIN = {
    "Anew": "The loop makes a new optimizer, and loses its moments on purpose. The line below each "
    "such call upgrades that one, too; the schedule goes on."
}
_TRAINERS_OF_INRIA = {
    "inria": _inria(
        "INRIA gaussian-splatting",
        "graphdeco-inria/gaussian-splatting",
        ("54c035f (2024-10-30)", "472689c (2024-04-05)"),
        step=(_INRIA_STEP, _STEP),
        counts={"gaussians.optimizer.step(": (1, 2), "total_loss.backward()": 0},
        notes={"Options": f"Exposures stay plain Adam. `--optimizer_type sparse_adam`: {_MASKED}"},
    ),
    "3dgs-mcmc": _inria(
        *("3dgs-mcmc", "ubc-vision/3dgs-mcmc", "7b4fc9f (2025-01-01)"),
        relocates=True,
        counts={"break": 0},
        notes={
            "Fewer iterations": "10,000 of its 30,000 are `--iterations 10000 "
            "--position_lr_max_steps 10000 --densify_from_iter 167 --densify_until_iter 8333 "
            "--densification_interval 33`. A degree of harmonics is still added every 1,000 "
            "iterations, a number that stands in train.py.",
            "Noise": "The trainer adds its own noise to the positions after each step, to their "
            "mean as well: add no `PositionNoise`.",
        },
    ),
    "2dgs": _inria(
        *("2D Gaussian Splatting", "hbb1/2d-gaussian-splatting", "1920a23 (2025-07-15)"),
        counts={"total_loss.backward()": 1},
        notes={
            "Flat Gaussians": "`DEFAULTS_ADC` takes them as they are. `OwnFrame`, which it does "
            "not have, would do nothing here: it takes three scales, and they have two."
        },
    ),
    "taming-3dgs": _inria(
        *("taming-3dgs", "humansensinglab/taming-3dgs", "fd0f7d9 (2025-06-16)"),
        step="            if iteration < opt.iterations:\n"
        '                if opt.optimizer_type == "default":\n'
        "                    gaussians.optimizer.step()",
        upgrade="phases.upgrade([o for o in (gaussians.optimizer, gaussians.shoptimizer) if o])",
        counts={"break": 0, "shoptimizer": 4, "gaussians.optimizer.step(": 2},
        notes={
            "Two optimizers": "The higher harmonics have an optimizer of their own, stepped in "
            "every 16th iteration with `--sh_lower`. Both are upgraded; the positions' counts."
        },
    ),
    "mini-splatting": _inria(
        *("mini-splatting, ms", "fatPeter/mini-splatting", "c0d5581 (2024-10-12)"),
        file="ms/train.py",
        again=(
            Place(f"{' ' * 20}{_SETUP}", (UPGRADE,)),
            Place(f"{' ' * 16}{_SETUP}", (UPGRADE,), times=2),
        ),
        counts={".training_setup(": 4},
        notes=_AGAIN,
    ),
    "mini-splatting-d": _inria(
        *("mini-splatting, ms_d", "fatPeter/mini-splatting", "c0d5581 (2024-10-12)"),
        file="ms_d/train.py",
        again=(
            Place(f"{' ' * 20}{_SETUP}", (UPGRADE,)),
            Place(f"{' ' * 16}{_SETUP}", (UPGRADE,)),
        ),
        counts={".training_setup(": 3},
        notes=_AGAIN,
    ),
}
_GRENDEL = Trainer(
    title="Grendel-GS",
    repository="nyu-systems/Grendel-GS",
    file="train_internal.py",
    read=("6e50e9a (2025-09-24)",),
    relocates=False,
    places=(
        _HEAD,
        Place(
            "    progress_bar.update(start_from_this_iteration - 1)",
            (
                "phases = PhaseScheduler((opt_args.iterations - 2) // args.bsz + 1{parts})",
                UPGRADE,
            ),
            above=True,
        ),
    ),
    signs=(
        "        start_from_this_iteration, opt_args.iterations + 1, args.bsz",
        "            if iteration < opt_args.iterations:",
        "                if not args.stop_update_param:\n"
        "                    gaussians.optimizer.step()",
    ),
    counts={".backward(": 1, "break": 0, "continue": 0, ".training_setup(": 1},
    notes={
        "Density control": _ADC,
        "Length": "The trainer counts images and makes a step for each batch, none after the last "
        "image: that number stands in the line.",
        "Several ranks": "Give the scheduler `process_group=utils.DEFAULT_GROUP if "
        "utils.DEFAULT_GROUP.size() > 1 else None`.",
        "Resume": "Checkpoints hold the optimizer, and with it the place in the schedule.",
    },
)

# -- others ----------------------------------------------------------------------------------------

_3DGRUT = Trainer(
    title="3DGRUT",
    repository="nv-tlabs/3dgrut",
    file="threedgrut/trainer.py",
    read=("a37ef72 (2026-07-08)",),
    relocates='conf.strategy.method == "MCMCStrategy"',
    places=(
        _HEAD,
        Place(
            "        self.n_epochs = int((conf.n_iterations + len(train_dataset) - 1)"
            " / len(train_dataset))",
            (
                "self.phases = PhaseScheduler(conf.n_iterations{parts})",
                "self.phases.upgrade(self.model.optimizer)",
            ),
        ),
    ),
    signs=(
        "            if self.global_step >= conf.n_iterations:",
        "            if isinstance(self.model.optimizer, SelectiveAdam):",
        "                self.model.optimizer.step()",
    ),
    counts={"model.optimizer.step(": 2, ".setup_optimizer()": 1, "self.n_epochs = ": 2},
    notes={
        "Density control": f"`MCMCStrategy` relocates, `GSStrategy` clones and splits. {_BOTH}",
        "Resume": "Checkpoints hold the optimizer, and with it the place in the schedule.",
        "Options": f"`optimizer.type=selective_adam`: {_MASKED} The texture `features` of the NHT "
        "mode and its decoder stay plain Adam. Where distillation freezes the Gaussians, "
        "give the scheduler the iteration at which it begins.",
    },
)
_FVDB = Trainer(
    title="fVDB reality capture",
    repository="openvdb/fvdb-reality-capture",
    file="fvdb_reality_capture/radiance_fields/gaussian_splat_reconstruction.py",
    read=("0.6.0 of the package index (2026-09)",),
    relocates='type(self.optimizer).__name__.endswith("MCMC")',
    places=(
        _HEAD,
        Place(
            "        for epoch in range(start_epoch, self.config.max_epochs):",
            (
                "phases = PhaseScheduler(total_steps{parts})",
                "phases.upgrade(self.optimizer._optimizer)",
            ),
            above=True,
        ),
    ),
    signs=(
        "        total_steps: int = self.config.max_steps if self.config.max_steps is not None"
        " else computed_total_steps",
        "                self.optimizer.step()\n"
        "                self.optimizer.zero_grad(set_to_none=True)",
    ),
    counts={"self.optimizer.step(": 1, "total_steps = ": 0, "self._optimizer = ": 1},
    notes={
        "Density control": f"`GaussianSplatOptimizerMCMC` relocates. {_BOTH}",
        "Resume": "Checkpoints hold the optimizer, and with it the place in the schedule.",
        "2025": "In the repository's form of 2025 (commit 0761837) the loop is in "
        "training/scene_optimization_runner.py and goes over range(self.config.max_epochs), and "
        "the optimizers are `self.optimizer._optimizers`.",
    },
)
_CITY = Trainer(
    title="CityGaussian",
    repository="Linketic/CityGaussian",
    file="internal/gaussian_splatting.py",
    read=("ad9a883 (2025-03-27)",),
    relocates='type(self.density_controller).__name__.startswith("MCMC")',
    places=(
        _HEAD,
        Place(
            "        add_optimizers_and_schedulers(gaussian_optimizers, gaussian_schedulers)",
            (
                "self.phases = PhaseScheduler(self.trainer.max_steps{parts})",
                "self.phases.upgrade(self.gaussian_optimizers)",
            ),
            above=True,
        ),
    ),
    signs=(
        "        self.gaussian_optimizers = gaussian_optimizers",
        "        for optimizer in optimizers:\n            optimizer.step()",
    ),
    counts={"optimizer.step(": 1, "self.gaussian_optimizers = ": 2},
    notes={
        "Density control": f"`MCMCDensityController` relocates. {_BOTH}",
        "Resume": "Lightning loads the optimizers' states after the lines, and the training goes "
        "on in its place.",
        "Length": "Where the trainer counts epochs, `max_steps` is -1: write the number of "
        "iterations in its place.",
    },
)
_DRIVE = Trainer(
    title="drivestudio",
    repository="ziyc/drivestudio",
    file="models/trainers/base.py",
    read=("e59bda4 (2025-08-27)",),
    relocates=False,
    places=(
        _HEAD,
        Place(
            "        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)",
            (
                "self.phases = PhaseScheduler(self.num_iters + 1{parts})",
                "self.phases.upgrade(self.optimizer)",
            ),
        ),
    ),
    signs=("        self.optimizer.step()", "        self.optimizer_step()"),
    counts={".backward(": 1, "self.optimizer = ": 1, "self.num_iters = ": 1},
    notes={
        "Density control": _ADC,
        "Length": "The loop of tools/train.py goes from 0 to `num_iters`, both included.",
        "Sets": "The one Adam holds several sets of Gaussians, `Background#xyz`, "
        "`RigidNodes#xyz` and so on. Sky, poses and networks stay plain Adam.",
        "Resume": "The trainer saves no optimizer. To go on with the schedule write "
        "`self.phases.observe(iteration=self.step)` below the lines.",
    },
)
_FASTER = Trainer(
    title="Faster-GS (NeRFICG)",
    repository="nerficg-project/faster-gaussian-splatting",
    file="Model.py",
    read=("3cb0b75 (2026-08-20)",),
    relocates="training_wrapper.USE_MCMC",
    inserted=False,
    places=(
        _HEAD,
        Place(
            "        self.optimizer = FusedAdam(param_groups, lr=0.0, eps=1e-15)",
            (
                "self.optimizer = torch.optim.Adam(param_groups, lr=0.0, eps=1e-15, fused=True)",
                "self.phases = PhaseScheduler(training_wrapper.NUM_ITERATIONS{parts})",
                "self.phases.upgrade(self.optimizer)",
            ),
        ),
    ),
    notes={
        "By hand": "`FusedAdam` has a step of its own and is refused. The first line takes its "
        "place, with torch's fused Adam, so that the line with `FusedAdam` goes.",
        "Density control": _BOTH,
        "Resume": "The trainer saves no optimizer.",
        "Branches": "Where Adam is fused into the backward pass, no optimizer is left to upgrade.",
    },
)
_LIGHTNING = Trainer(
    title="gaussian-splatting-lightning",
    repository="yzslab/gaussian-splatting-lightning",
    file="no file changes: name the plugin in a configuration, opt3dgs.yaml",
    read=("ee022aa (2026-03-14)",),
    relocates=True,
    inserted=False,
    places=(
        Place(
            "opt3dgs.yaml, given with `main.py fit --config opt3dgs.yaml`",
            ("model:", "  plugins:", "    - class_path: opt3dgs_optim.hosts.lightning.Opt3DGS"),
        ),
    ),
    notes={
        "Density control": "The plugin looks which one is at work. `MCMCDensityController` has the "
        "default parts, every other one the preset `DEFAULTS_ADC`.",
        "Resume": "`--ckpt_path` goes on in the checkpoint's place. From a checkpoint of the "
        "unchanged trainer the iteration of the trainer says the place.",
        "Length": "It is the trainer's `--max_steps`. Where that counts epochs, give the plugin "
        "`init_args: {total_steps: N}`.",
        "Options": "`GradAccOptStrategy` and the trainer's sparse Adams are refused.",
    },
)
_NERFSTUDIO = Trainer(
    title="nerfstudio, splatfacto",
    repository="nerfstudio-project/nerfstudio",
    file="no file changes: the package brings methods",
    read=("main 50e0e3c (2025-07-28)", "v1.1.5 6b60855"),
    relocates=True,
    inserted=False,
    places=(
        Place(
            "the command line",
            (
                "ns-train splatfacto-opt3dgs --data DATA",
                "ns-train splatfacto-mcmc-opt3dgs --data DATA  # where nerfstudio has it",
            ),
        ),
    ),
    notes={
        "Density control": "`splatfacto` clones, splits and prunes, and has the preset "
        "`DEFAULTS_ADC`; `splatfacto-mcmc`, which came after 1.1.5, the default parts.",
        "Length": "It is the trainer's `--max-num-iterations`; 1.1.5 makes that many *more* "
        "iterations after a resume, and the schedule ends where they do.",
        "Resume": "nerfstudio's own resume of splatfacto is broken, with this package and without "
        "it: its optimizers still hold the Parameters from before the checkpoint, so that nothing "
        "steps the Gaussians until the next densification, and the next checkpoint stops with a "
        "KeyError. Train in one piece.",
        "Options": "Leave gradient accumulation at 1.",
    },
)

TRAINERS: dict[str, Trainer] = {
    "gsplat": _GSPLAT,
    "gsplat-2dgs": _GSPLAT_2DGS,
    **_TRAINERS_OF_INRIA,
    "grendel-gs": _GRENDEL,
    "faster-gs": _FASTER,
    "3dgrut": _3DGRUT,
    "fvdb": _FVDB,
    "lightning": _LIGHTNING,
    "citygaussian": _CITY,
    "drivestudio": _DRIVE,
    "nerfstudio": _NERFSTUDIO,
}
ANY = """\
from opt3dgs_optim import PhaseScheduler

# above the training loop, when the optimizers are made and a checkpoint is loaded
phases = PhaseScheduler(N)  # N: how many steps the training makes
phases.upgrade(OPTIMIZERS)  # a torch.optim.Adam with named groups, a dict of them, or a list
# with clone, split and prune: PhaseScheduler(N, parts=DEFAULTS_ADC), imported beside it"""
