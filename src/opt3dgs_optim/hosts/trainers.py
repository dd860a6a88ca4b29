"""What tells the file of each known trainer from every other file.

Its lines are on its page in docs/hosts.
"""

from __future__ import annotations

from collections.abc import Mapping

from opt3dgs_optim.hosts.pages import Trainer

# -- gsplat ----------------------------------------------------------------------------------------

_GSPLAT_SIGNS = (
    "        max_steps = cfg.max_steps",
    "        pbar = tqdm.tqdm(range(init_step, max_steps))",
    "        for step in pbar:",
    "        self.splats, self.optimizers = create_splats_with_optimizers(",
    (
        "            for optimizer in self.optimizers.values():\n"
        "                optimizer.step()\n"
        "                optimizer.zero_grad(set_to_none=True)",
        "            for optimizer in self.optimizers.values():\n"
        "                if cfg.visible_adam:\n"
        "                    optimizer.step(visibility_mask)\n"
        "                else:\n"
        "                    optimizer.step()",
    ),
)
_GSPLAT_COUNTS = {
    **{".backward(": 1, "break": 0, "continue": 1, "max_steps = ": 2, "self.optimizers = ": 1},
    "self.optimizers[": 1,
}

# -- INRIA's trainer and what derives from it ------------------------------------------------------

_STEP = (
    "            if iteration < opt.iterations:\n"
    "                gaussians.optimizer.step()\n"
    "                gaussians.optimizer.zero_grad(set_to_none = True)"
)
_INRIA_STEP = (
    "            if iteration < opt.iterations:\n"
    "                gaussians.exposure_optimizer.step()"
)
_PGSR_STEP = (
    "            if iteration < opt.iterations:\n"
    "                gaussians.optimizer.step()\n"
    "                app_model.optimizer.step()\n"
    "                gaussians.optimizer.zero_grad(set_to_none = True)"
)
_TAMING_STEP = (
    "            if iteration < opt.iterations:\n"
    '                if opt.optimizer_type == "default":\n'
    "                    gaussians.optimizer.step()"
)


def _inria(
    anchor: str,
    *further: str,
    step: str | tuple[str, ...] = _STEP,
    counts: Mapping[str, int | tuple[int, ...]],
) -> Trainer:
    """A trainer with INRIA's loop; `counts` beside or in the place of its own."""
    usual: dict[str, int | tuple[int, ...]] = {
        **{".backward(": 1, "continue": 0, "break": 1, ".training_setup(": 1, ".restore(": 1},
        **{"opt.iterations =": 0, "relocate_gs(": 0, "shoptimizer": 0, "GaussianModel(": 1},
        **{"gaussians.optimizer.step(": 1, "gaussians.optimizer =": 0},
    }
    return Trainer(
        sections=("inria.md", *(f"inria.md#{each}" for each in (anchor, *further))),
        signs=("    first_iter = 0", "    first_iter += 1", step),
        counts={**usual, **counts},
    )


TRAINERS: dict[str, Trainer] = {
    "gsplat": Trainer(
        ("gsplat.md", "gsplat.md#simple_trainerpy"),
        (*_GSPLAT_SIGNS, "from gsplat.strategy import DefaultStrategy, MCMCStrategy"),
        _GSPLAT_COUNTS,
    ),
    "gsplat-2dgs": Trainer(
        ("gsplat.md", "gsplat.md#simple_trainer_2dgspy"),
        (*_GSPLAT_SIGNS, "from gsplat.strategy import DefaultStrategy"),
        _GSPLAT_COUNTS,
    ),
    "inria": _inria(
        "gaussian-splatting",
        step=(_INRIA_STEP, _STEP, _PGSR_STEP),
        counts={
            **{"gaussians.optimizer.step(": (1, 2), "total_loss.backward()": 0},
            "break": (0, 1),  # some have no viewer
        },
    ),
    "3dgs-mcmc": _inria("3dgs-mcmc", counts={"break": 0, "relocate_gs(": 1}),
    "2dgs": _inria("2d-gaussian-splatting", counts={"total_loss.backward()": 1}),
    "taming-3dgs": _inria(
        "taming-3dgs",
        step=_TAMING_STEP,
        counts={"break": 0, "shoptimizer": 4, "gaussians.optimizer.step(": 2},
    ),
    "mini-splatting": _inria("mini-splatting", counts={".training_setup(": 4}),
    "mini-splatting-d": _inria("mini-splatting", "ms_dtrainpy", counts={".training_setup(": 3}),
    "grendel-gs": Trainer(
        ("inria.md#grendel-gs",),
        (
            "        start_from_this_iteration, opt_args.iterations + 1, args.bsz",
            "            if iteration < opt_args.iterations:",
            "                if not args.stop_update_param:\n"
            "                    gaussians.optimizer.step()",
        ),
        {".backward(": 1, "break": 0, "continue": 0, ".training_setup(": 1},
    ),
    "faster-gs": Trainer(("inria.md#faster-gs",)),
    "3dgrut": Trainer(
        ("3dgrut.md",),
        (
            "            if self.global_step >= conf.n_iterations:",
            "            if isinstance(self.model.optimizer, SelectiveAdam):",
            "                self.model.optimizer.step()",
        ),
        {"model.optimizer.step(": 2, ".setup_optimizer()": 1, "self.n_epochs = ": 2},
    ),
    "fvdb": Trainer(
        ("fvdb.md",),
        (
            "        total_steps: int = self.config.max_steps if self.config.max_steps is not None"
            " else computed_total_steps",
            "                self.optimizer.step()\n"
            "                self.optimizer.zero_grad(set_to_none=True)",
        ),
        {"self.optimizer.step(": 1, "total_steps = ": 0, "self._optimizer = ": 1},
    ),
    "lightning": Trainer(("lightning.md",)),
    "citygaussian": Trainer(
        ("lightning.md#citygaussian",),
        (
            "        self.gaussian_optimizers = gaussian_optimizers",
            "        for optimizer in optimizers:\n            optimizer.step()",
        ),
        {"optimizer.step(": 1, "self.gaussian_optimizers = ": 2},
    ),
    "drivestudio": Trainer(
        ("other.md#drivestudio",),
        ("        self.optimizer.step()", "        self.optimizer_step()"),
        {".backward(": 1, "self.optimizer = ": 1, "self.num_iters = ": 1},
    ),
    "nerfstudio": Trainer(("nerfstudio.md",)),
}
