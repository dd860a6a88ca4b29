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


class PixelLoss(NamedTuple):
    """A photometric L1 term."""

    value: ast.expr  # what to replace
    images: list[ast.expr]  # its two arguments


def find_pixel_loss(inside: list[Spot], loop: ast.stmt, last: int) -> list[PixelLoss]:
    """The photometric term above a line: `L1 = l1_loss(a, b)`, alone or with `.mean()`.

    Several only where branches write the same name; none where it is not certain which it is.
    """
    found: dict[str, list[tuple[Spot, PixelLoss]]] = {}
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
                if usual and shown and not other and loops_around(spot)[-1] is loop:
                    found.setdefault(name, []).append((spot, PixelLoss(spot.node.value, pair)))
    terms = next(iter(found.values())) if len(found) == 1 else []
    places = [spot for spot, _ in terms]
    if not all(are_exclusive(one, other) for one, other in combinations(places, 2)):
        return []
    return [term for _, term in terms]


def _written(image: ast.expr, inside: list[Spot]) -> str:
    """An image's expression, and what its names are given in the loop: says what it shows.

    A mask that picks pixels says nothing of what is picked.
    """
    picked = image.value if isinstance(image, ast.Subscript) else image
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
