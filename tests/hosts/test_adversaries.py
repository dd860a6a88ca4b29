"""Trainers that an adversary wrote: the edit gives the trainer's own clock, or it is refused.

Each script trains a few Gaussians with the real `PhaseScheduler` and torch's Adam, stock and
edited.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import added

from opt3dgs_optim.hosts import diff

HEAD = "import itertools\nimport torch\nfrom trainer import *\n\n"
EDITED = {
    "break on nan is fine": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        if torch.isnan(loss):
            break
        loss.backward()
        gaussians.optimizer.step()


training(opt)
""",
    "start added": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    start = 3
    for i in range(start, start + 5):
        saw(i, start + 5)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "scaler": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    scaler = torch.amp.GradScaler('cpu', enabled=True, init_scale=4.0)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        scaler.scale(loss).backward()
        scaler.step(gaussians.optimizer)
        scaler.update()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "made anew in the loop, assigned": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        if iteration == 4:
            gaussians.optimizer = adam()
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "restored in the loop": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        if iteration == 4:
            gaussians.restore(gaussians.optimizer.state_dict(), opt)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "made anew by a function in the file": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    def reset(model):
        model.training_setup(opt)

    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        if iteration == 4:
            reset(gaussians)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "named torch Adam made anew": """\
def training():
    parameters.append(torch.nn.Parameter(torch.ones(3, 3)))
    optimizer = torch.optim.Adam([dict(params=parameters[:1], name='xyz')])
    watch(optimizer)
    for iteration in range(8):
        saw(iteration, 8)
        if iteration == 3:
            optimizer = torch.optim.Adam([dict(params=[parameters[0]], name='xyz')])
            watch(optimizer)
        loss = loss_of()
        loss.backward()
        optimizer.step()
training()
""",
    "gsplat dict made anew": """\
class Runner:
    def __init__(self):
        self.optimizers = make_optimizers()
    def train(self):
        max_steps = 8
        for step in range(max_steps):
            saw(step, max_steps)
            if step == 3:
                self.optimizers = make_optimizers()
            loss = loss_of()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
Runner().train()
""",
    "gsplat dict made anew in a method": """\
class Runner:
    def __init__(self):
        self.make()
    def make(self):
        self.optimizers = make_optimizers()
    def train(self):
        max_steps = 8
        for step in range(max_steps):
            saw(step, max_steps)
            if step == 3:
                self.make()
            loss = loss_of()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
Runner().train()
""",
    "gsplat resumed below the rate schedulers": """\
class Runner:
    def __init__(self):
        self.optimizers = make_optimizers()
    def resume(self):
        self.optimizers = make_optimizers()
    def train(self):
        max_steps = 8
        schedulers = [torch.optim.lr_scheduler.ExponentialLR(self.optimizers["means"], 0.9)]
        self.resume()
        for step in range(max_steps):
            saw(step, max_steps)
            loss = loss_of()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
Runner().train()
""",
    "two lists in turn": """\
class Runner:
    def __init__(self):
        self.optimizers = [adam()]
        self.pose_optimizers = []
    def train(self):
        for step in range(8):
            saw(step, 8)
            loss = loss_of()
            loss.backward()
            for optimizer in self.optimizers:
                optimizer.step()
                optimizer.zero_grad()
            for optimizer in self.pose_optimizers:
                optimizer.step()
Runner().train()
""",
    "argparse start": """\
import argparse
def training(args):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in tqdm(range(args.start_iteration, args.iterations + 1)):
        saw(iteration, args.iterations + 1)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()

parser = argparse.ArgumentParser()
parser.add_argument("--start_iteration", type=int, default=3)
parser.add_argument("--iterations", type=int, default=8)
training(parser.parse_args([]))
""",
    "losses in a dict": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        losses = dict(l1=loss_of(), ssim=loss_of())
        total = sum(losses.values())
        total.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "losses of all batches in a list": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        batch = []
        for view in range(3):
            batch.append(loss_of())
        loss = torch.stack(batch).mean()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "own PhaseScheduler": """\
class PhaseScheduler:
    pass
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    phases = PhaseScheduler()
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()

        gaussians.densify_and_prune(1)
training(opt)
""",
    "L1 twice under one name, depth last": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        image, gt_image = render()
        inverse_z, prior = render()
        scales, velocity = render()
        Ll1 = l1_loss(image, gt_image)
        loss = Ll1 + loss_of()
        Ll1 = l1_loss(inverse_z, prior)
        loss = loss + Ll1
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "L1 twice under one name, depth first": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        image, gt_image = render()
        inverse_z, prior = render()
        scales, velocity = render()
        Ll1 = l1_loss(inverse_z, prior)
        loss = Ll1 + loss_of()
        Ll1 = l1_loss(image, gt_image)
        loss = loss + Ll1
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "L1 of scales": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        image, gt_image = render()
        inverse_z, prior = render()
        scales, velocity = render()
        Ll1 = l1_loss(scales, prior)
        loss = Ll1 + loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "L1 of motion": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        image, gt_image = render()
        inverse_z, prior = render()
        scales, velocity = render()
        Ll1 = l1_loss(velocity, prior)
        loss = Ll1 + loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "L1 of the image unpacked from a package": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        image, gt_image = render()
        inverse_z, prior = render()
        scales, velocity = render()
        image, z = render()
        Ll1 = l1_loss(z, prior)
        loss = Ll1 + loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "trange": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    pbar = trange(opt.iterations)
    for iteration in pbar:
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "loaded above the loop": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    first = 1
    saved = gaussians.optimizer.state_dict()
    gaussians.optimizer.load_state_dict(saved)
    first = 4
    for iteration in range(first, opt.iterations + 1):
        saw(iteration - 1, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "loaded in the first turn": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        if iteration == 0:
            gaussians.optimizer.load_state_dict(gaussians.optimizer.state_dict())
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
}
REFUSED = {  # and what the refusal says
    "sentinel range with break": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(10**6):
        if iteration >= opt.iterations:
            break
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "break at the end of the body": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(100):
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        if iteration + 1 == opt.iterations:
            break


training(opt)
""",
    "break by a flag": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(100):
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        done = iteration + 1 == opt.iterations
        if done:
            break


training(opt)
""",
    "break by own counter": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    count = 0
    for _ in range(100):
        saw(count, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        count += 1
        if count == opt.iterations:
            break


training(opt)
""",
    "return at the end": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(100):
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        if iteration + 1 == opt.iterations:
            return


training(opt)
""",
    "rest of a training": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    start = 3
    for i in range(opt.iterations - start):
        saw(start + i, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "rest of a training by name": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    start = 3
    left = opt.iterations - start
    for i in range(left):
        saw(start + i, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "scaled loss has the name": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    scaler = torch.amp.GradScaler('cpu', enabled=True, init_scale=4.0)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = scaler.scale(loss_of())
        loss.backward()
        scaler.step(gaussians.optimizer)
        scaler.update()


training(opt)
""",
    "two lists in a sum": """\
class Runner:
    def __init__(self):
        self.optimizers = [adam()]
        self.pose_optimizers = []
    def train(self):
        for step in range(8):
            saw(step, 8)
            loss = loss_of()
            loss.backward()
            for optimizer in self.pose_optimizers + self.optimizers:
                optimizer.step()
                optimizer.zero_grad()
Runner().train()
""",
    "chain": """\
class Runner:
    def __init__(self):
        self.optimizers = [adam()]
        self.pose_optimizers = []
    def train(self):
        for step in range(8):
            saw(step, 8)
            loss = loss_of()
            loss.backward()
            for optimizer in itertools.chain(self.pose_optimizers, self.optimizers):
                optimizer.step()
                optimizer.zero_grad()
Runner().train()
""",
    "named adam made anew": """\
def training():
    optimizer = adam()
    for iteration in range(8):
        saw(iteration, 8)
        if iteration == 3:
            optimizer = adam()
        loss = loss_of()
        loss.backward()
        optimizer.step()
training()
""",
    "counter accumulates": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    done = 0
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        done += 1
        if done == 2:
            gaussians.optimizer.step()
            done = 0


training(opt)
""",
    "a function decides": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    def due(i):
        return i % 2 == 1
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        if due(iteration):
            gaussians.optimizer.step()


training(opt)
""",
    "losses in a dict, no name": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        losses = dict(l1=loss_of(), ssim=loss_of())
        sum(losses.values()).backward()
        gaussians.optimizer.step()


training(opt)
""",
    "mutual recursion": """\
gaussians = GaussianModel()
gaussians.training_setup(opt)
def again(n):
    if n:
        training(n - 1)
def training(n):
    for iteration in range(8):
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()

    again(n)
training(1)
""",
    "stages of an object from elsewhere": """\
class Runner:
    def __init__(self):
        self.optimizers = make_optimizers()
    def run_stage(self):
        for step in range(8):
            saw(self.done + step, 16)
            loss = loss_of()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
        self.done += 8
    done = 0
def main(runner):
    for stage in range(2):
        runner.run_stage()
main(Runner())
""",
    "while true": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    iteration = 0
    while True:
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        iteration += 1
        if iteration == 8: break


training(opt)
""",
    "count": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in itertools.count(0):
        if iteration == 8: break
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "enumerate": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration, view in enumerate(loader, start=1):
        saw(iteration - 1, 8)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "sliced range": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    for iteration in range(opt.iterations)[2:]:
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
    "step by variable counting down": """\
def training(opt):
    gaussians = GaussianModel()
    gaussians.training_setup(opt)
    by = -1
    for iteration in range(opt.iterations, 0, by):
        saw(opt.iterations - iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()


training(opt)
""",
}
REASONS = {
    "sentinel range with break": "is left where iteration >= opt.iterations",
    "break at the end of the body": "is left where iteration + 1 == opt.iterations",
    "break by a flag": "is left where done",
    "break by own counter": "is left where count == opt.iterations",
    "return at the end": "is left where",
    "rest of a training": "may be the rest of a training",
    "rest of a training by name": "may be the rest of a training",
    "scaled loss has the name": "scaled by a factor that changes",
    "two lists in a sum": "it is not clear what are the Gaussians' optimizers",
    "chain": "the optimizer of the Gaussians is not clear",
    "named adam made anew": "the optimizer of the Gaussians is not clear",
    "counter accumulates": "steps only where done == 2",
    "a function decides": "steps only where due(iteration)",
    "losses in a dict, no name": "of a loss with a name",
    "mutual recursion": "is called twice",
    "stages of an object from elsewhere": "is called in a loop",
    "while true": "is a `while`",
    "count": "goes over itertools.count(0)",
    "enumerate": "goes over enumerate(",
    "sliced range": "goes over range(opt.iterations)[2:]",
    "step by variable counting down": "counts down",
}
PIXEL_LOSS = {
    "L1 twice under one name, depth last": "Ll1 = phases.pixel_loss(image, gt_image)",
    "L1 twice under one name, depth first": "Ll1 = phases.pixel_loss(image, gt_image)",
    "L1 of scales": "",
    "L1 of motion": "",
    "L1 of the image unpacked from a package": "",
}


def saved(folder: Path, text: str) -> Path:
    path = folder / "train.py"
    path.write_text(HEAD + text)
    return path


@pytest.mark.parametrize("kind", EDITED)
def test_every_step_has_the_trainers_clock(tmp_path: Path, kind: str) -> None:
    path = saved(tmp_path, EDITED[kind])
    stock, edited = run(path.read_bytes()), run(diff(path).new)
    assert stock.clock
    assert stock.scheduled == [None] * len(stock.clock)
    assert edited.clock == stock.clock
    # Every step has the parts, and is as far from the schedule's end as from the training's.
    left = [None if said is None else said[1] - said[0] for said in edited.scheduled]
    assert left == [total - count for count, total in stock.clock]
    assert edited.warned == stock.warned


@pytest.mark.parametrize("kind", REFUSED)
def test_what_gives_no_clock_is_refused(tmp_path: Path, kind: str) -> None:
    """The script itself runs: it is no nonsense that is refused."""
    path = saved(tmp_path, REFUSED[kind])
    assert run(path.read_bytes()).clock
    with pytest.raises(ValueError, match=r"^line \d+: ") as refused:
        diff(path)
    assert REASONS[kind] in str(refused.value)


@pytest.mark.parametrize("kind", PIXEL_LOSS)
def test_only_the_photos_term_is_replaced(tmp_path: Path, kind: str) -> None:
    lines = added(diff(saved(tmp_path, EDITED[kind])).diff)
    assert [line for line in lines if "pixel_loss" in line] == [PIXEL_LOSS[kind]][
        : bool(PIXEL_LOSS[kind])
    ]


def test_another_object_with_the_optimizers(tmp_path: Path) -> None:
    text = EDITED["restored in the loop"].replace(
        "gaussians.restore(gaussians.optimizer.state_dict(), opt)", "gaussians = GaussianModel()"
    )
    with pytest.raises(ValueError, match="which has the optimizers, gets another value here"):
        diff(saved(tmp_path, text))


def test_optimizers_made_in_a_condition(tmp_path: Path) -> None:
    text = EDITED["restored in the loop"].replace(
        "if iteration == 4:", "if gaussians.training_setup(opt):"
    )
    with pytest.raises(ValueError, match="give it a statement of its own"):
        diff(saved(tmp_path, text))


def test_methods_of_the_models_file_that_make_optimizers(tmp_path: Path) -> None:
    """Read from `scene/`, also through the methods that they call."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "gaussian_model.py").write_text(
        "class GaussianModel:\n"
        "    def rebuild(self):\n        self.optimizer = Adam(self.groups())\n"
        "    def grow(self):\n        self.rebuild()\n"
        "    def forget(self):\n        self.optimizer = None\n"
    )
    text = EDITED["restored in the loop"]
    call = "gaussians.restore(gaussians.optimizer.state_dict(), opt)"
    for name, upgrades in (("grow", 2), ("rebuild", 2), ("forget", 1), ("other", 1)):
        lines = added(diff(saved(tmp_path, text.replace(call, f"gaussians.{name}()"))).diff)
        assert sum(".upgrade(" in line for line in lines) == upgrades, name


def test_methods_that_call_each_other_end(tmp_path: Path) -> None:
    text = """\
gaussians = GaussianModel()
def again():
    training()
def training():
    for iteration in range(8):
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
    again()
"""
    with pytest.raises(ValueError, match=r"^line \d+: .*calls itself"):
        diff(saved(tmp_path, text))


def test_a_smaller_photo_is_a_photo(tmp_path: Path) -> None:
    """DashGaussian: the photo is made smaller, by a function that is given a scale."""
    text = EDITED["L1 twice under one name, depth last"].replace(
        "    for iteration", "    torch.scaled = lambda x, scale: [x]\n    for iteration"
    )
    text = text.replace(
        "inverse_z, prior",
        "gt_image = torch.scaled(gt_image, scale=2)[0]\n        inverse_z, prior",
        1,
    )
    lines = added(diff(saved(tmp_path, text)).diff)
    assert "Ll1 = phases.pixel_loss(image, gt_image)" in lines


def test_an_error_at_a_count_ends_no_training(tmp_path: Path) -> None:
    """LightGaussian refuses options that it does not know where it prunes."""
    text = EDITED["restored in the loop"].replace(
        "gaussians.restore(gaussians.optimizer.state_dict(), opt)", "raise ValueError(opt)"
    )
    assert "PhaseScheduler(opt.iterations)" in diff(saved(tmp_path, text)).diff
