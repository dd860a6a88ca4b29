"""Where a training loop computes the L1 term of photos."""

import ast
import re
from itertools import combinations
from typing import NamedTuple

from opt3dgs_optim.hosts.syntax import Spot, are_exclusive, loops_around, values

USUAL_L1 = ("ll1", "l1loss", "l1_loss", "ll1_render", "loss_l1", "l1", "photometric_loss")
# A render or a photo, by the names that trainers give them, and what is none.
PHOTO = re.compile(r"image|img|render|rgb|colou?r|pixel|photo|pred|gt|target|ground_?truth", re.I)
NO_PHOTO = re.compile(
    r"depth|normal|disp(?!lay)|alpha|opac|flow|feat|semantic|scal|rotat|quat|xyz|position|mean|"
    r"offset|deform|motion|veloc|delta|dist|weight|laplac|grad",
    re.I,
)

# What makes another number of an elementwise term than of its mean.
REDUCTIONS = {
    *("amax", "amin", "max", "mean", "median", "min", "nanmean", "norm", "prod", "quantile"),
    *("std", "sum", "topk"),
}


class PixelLoss(NamedTuple):
    """A photometric L1 term."""

    value: ast.expr  # what to replace
    images: list[ast.expr]  # its two arguments


def find_pixel_loss(
    tree: ast.Module, inside: list[Spot], loop: ast.stmt, last: int
) -> tuple[list[PixelLoss], list[int]]:
    """The photometric term above a line: `L1 = l1_loss(a, b)`, alone or with `.mean()`.

    Args:
        tree: the file's syntax tree.
        inside: every node of the training loop.
        loop: the training loop.
        last: the line.

    Returns:
        The terms, and the lines of others of two photos. Several terms only where branches write
        the same name; none where it is not certain which it is, or that it is the mean of the
        absolute error.
    """
    found: dict[str, list[tuple[Spot, PixelLoss]]] = {}
    others: list[int] = []
    above = [spot for spot in inside if spot.line <= last]  # what is logged below is no loss
    for spot in inside:
        match spot.node:
            case ast.Assign(
                [target, *_],
                ast.Call(ast.Attribute(ast.Call(called, [_, _] as pair, []), "mean"), [], [])
                | ast.Call(called, [_, _] as pair, []),
            ) if ast.unparse(called).split(".")[-1] == "l1_loss" and spot.line < last:
                name = ast.unparse(target)
                images = [_written(each, inside) for each in pair]
                other = NO_PHOTO.search(" ".join([name, *images]))
                shown = all(PHOTO.search(each) for each in images)
                usual = name.lower() in USUAL_L1
                mean = ast.unparse(spot.node.value).endswith(").mean()")
                certain = _is_mean(tree, mean) and (mean or not _is_reduced(name, spot, above))
                if not shown or other or loops_around(spot)[-1] is not loop:
                    continue
                if not usual:
                    others.append(spot.line)
                    continue
                if not certain or _is_without_gradient(spot) or not _have_one_shape(pair, inside):
                    return [], []
                found.setdefault(name, []).append((spot, PixelLoss(spot.node.value, pair)))
    terms = next(iter(found.values())) if len(found) == 1 else []
    places = [spot for spot, _ in terms]
    if not all(are_exclusive(one, other) for one, other in combinations(places, 2)):
        return [], []
    return [term for _, term in terms], others


def _is_mean(tree: ast.Module, of_elements: bool) -> bool:
    """Whether `l1_loss` may be taken for the mean absolute error, by what a file says of it.

    Args:
        tree: the file's syntax tree.
        of_elements: whether the mean is taken of what it returns.
    """
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef("l1_loss"):
                returned = [n.value for n in ast.walk(node) if isinstance(n, ast.Return)]
                for text in [ast.unparse(value) if value else "" for value in returned] or [""]:
                    mean = of_elements or re.fullmatch(r".*\.mean\(\)|torch\.mean\(.*\)", text)
                    if not mean or "abs(" not in text or "sum(" in text:
                        return False
            case ast.Name("l1_loss", ast.Store()) | ast.Attribute(_, "l1_loss", ast.Store()):
                return False
            case ast.alias(name, "l1_loss") if name != "l1_loss":
                return False
    return True


def _is_without_gradient(spot: Spot) -> bool:
    """Whether a term is computed for the log alone."""
    items = [item for node in spot.above if isinstance(node, ast.With) for item in node.items]
    return any(re.search("no_grad|inference_mode", ast.unparse(item)) for item in items)


def _have_one_shape(pair: list[ast.expr], inside: list[Spot]) -> bool:
    """Whether no axis is added to one of two images alone: the other is broadcast then."""
    added = []
    for image in pair:
        names = {node.id for node in ast.walk(image) if isinstance(node, ast.Name)}
        given = [value for name in names for _, value in values(inside, name) if value]
        added.append(any(map(_has_another_axis, (image, *given))))
    return added[0] == added[1]


def _has_another_axis(image: ast.expr) -> bool:
    """Whether an axis is added to an image, which may go on: `image[None].cuda()`."""
    match image:
        case ast.Subscript(value, index):
            return "None" in ast.unparse(index) or _has_another_axis(value)
        case ast.Call(ast.Attribute(_, "unsqueeze")):
            return True
        case ast.Call(value) | ast.Attribute(value):
            return _has_another_axis(value)
    return False


def _is_reduced(name: str, term: Spot, inside: list[Spot]) -> bool:
    """Whether a term is treated as one of many elements, or is in no loss.

    It is where a mean, a sum or an item of it is taken, or of what is computed with it.
    """
    computed, used = {name}, False
    after = getattr(term.node, "end_lineno", term.line)
    for spot in inside:
        match spot.node:
            case ast.Name(read, ast.Load()) if read in computed and spot.line > after:
                around = spot.above[-1]
            case _:
                continue
        if isinstance(around, ast.Attribute) and around.attr in ("item", "detach"):
            continue
        used |= read == name
        for around, below in zip(reversed(spot.above), reversed(spot.chain), strict=True):
            match around:
                case ast.Subscript(value) if value is below:
                    return True
                case ast.Call(ast.Attribute(_, method)) if method in REDUCTIONS:
                    return True
                case ast.Assign(targets) if below is around.value:
                    computed |= {ast.unparse(target) for target in targets}
                case ast.AugAssign(target) if below is around.value:
                    computed.add(ast.unparse(target))
            if isinstance(around, ast.stmt):
                break
    return not used


def _written(image: ast.expr, inside: list[Spot]) -> str:
    """An image's expression, and what its names are given in the loop: says what it shows.

    A mask that picks pixels says nothing of what is picked, as an index or as a factor.
    """
    picked = image.value if isinstance(image, ast.Subscript) else image
    match picked:
        case ast.BinOp(left, ast.Mult(), right) if "mask" in ast.unparse(right).lower():
            picked = left
        case ast.BinOp(left, ast.Mult(), right) if "mask" in ast.unparse(left).lower():
            picked = right
    names = {node.id for node in ast.walk(picked) if isinstance(node, ast.Name)}
    given = [value for name in names for _, value in values(inside, name)]
    # What a call is given, as the scale of a smaller photo, says nothing of what comes of it.
    plain = [v for v in given if v and isinstance(_source(v), ast.Name | ast.Attribute)]
    return " ".join(map(ast.unparse, (picked, *plain)))


def _source(value: ast.expr) -> ast.expr:
    """What an expression picks items or rows of."""
    while isinstance(value, ast.Subscript):
        value = value.value
    return value
