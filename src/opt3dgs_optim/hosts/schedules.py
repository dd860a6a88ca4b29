"""A trainer's whole schedule, shortened: `opt3dgs lines NAME --iterations N`.

Its page has the options of the stock schedule of 30,000 iterations, and the lines of its file in
which a number stands that no option has. Here each number is scaled by N/30,000. Ends are rounded
down and all else up, so that no refinement and no reset of opacities is added (gsplat rounds its
own down). A number with an exponent counts no iterations, and stays.
"""

from __future__ import annotations

import re

from opt3dgs_optim.hosts.pages import Trainer, section

STOCK = 30_000
FIRST = f"# {STOCK:,} iterations"
ENDS = ("until", "stop", "end_")  # in names of options at which something ends
NUMBER = r"(?<=[ =\[,])\d+(?:\.\d+)?(?=[ ,\]\n]|$)"


def schedule(trainer: Trainer) -> str | None:
    """The stock schedule, as its page has it; None where none is known."""
    text = "".join(section(place) for place in trainer.sections)
    found = re.findall(rf"^```text\n({FIRST}.+?)\n```$", text, re.M | re.S)
    return found[-1] if found else None


def shortened(stock: str, iterations: int) -> str:
    """A stock schedule, for so many iterations.

    Raises:
        ValueError: so many iterations are not to be had.
    """
    found = re.search(r"in multiples of (\d+)", stock)
    unit = int(found[1]) if found else 10
    if iterations < 300 or iterations % unit:
        raise ValueError(
            f"--iterations {iterations}, but a multiple of {unit} is needed, 300 or more"
        )
    groups = []
    for group in stock.split("\n\n"):
        comment, rest = group.split("\n", 1)
        if comment.startswith(FIRST):
            comment = comment.replace(FIRST, f"# {iterations:,} iterations")
            groups.append(f"{comment}\n{_command(rest, iterations)}")
        else:  # a line of the file
            where = re.sub(r"# in \S+,", f"# in the place of `{rest}`,", comment)
            new = re.sub(r"\b\d{4,}\b", lambda number: scaled("", number[0], iterations), rest)
            groups.append(f"{where}\n{new}")
    return "\n\n".join(groups)


def _command(words: str, iterations: int) -> str:
    """A command with its numbers scaled, each as the option before it asks."""
    option = ""

    def each(word: re.Match[str]) -> str:
        nonlocal option
        if word[0][0].isdigit():
            return scaled(option, word[0], iterations)
        option = word[0]
        return option

    return re.sub(rf"{NUMBER}|--[\w.]+|[\w.]+=", each, words)


def scaled(option: str, number: str, iterations: int) -> str:
    """What takes the place of a number."""
    if "." in number:  # a little more: gsplat rounds down what it multiplies
        return f"{float(number) * (iterations * 10**5 // STOCK + 1) / 10**5:.5f}"
    up = not any(word in option for word in ENDS)
    return str((int(number) * iterations + up * (STOCK - 1)) // STOCK)
