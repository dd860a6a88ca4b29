"""Which way a metric is better, known from its name or not at all."""

import re

# fmt: off
HIGHER_IS_BETTER = {
    "psnr", "mpsnr", "ssim", "mssim", "msssim", "snr", "fps", "accuracy", "iou", "miou",
}
LOWER_IS_BETTER = {
    "lpips", "mlpips", "dists", "flip", "fid", "kid", "dssim", "l1", "l2", "mse", "rmse", "mae",
    "absrel", "chamfer", "loss", "losses", "error", "errors", "energy",
}
# A word beside the metric's that makes another number of it, whose direction is its own.
CHANGES_MEANING = {
    "std", "stdev", "stddev", "var", "variance", "sem", "count", "num", "weight", "weights",
    "lambda", "coef", "coefficient", "scale", "factor", "ratio", "share", "fraction", "threshold",
    "target", "goal", "delta", "diff", "difference", "gap", "gain", "drop", "improvement", "grad",
    "gradient", "norm", "rate", "lr", "neg", "negative", "minus", "inv", "inverse", "seconds",
    "sec", "time", "iteration", "iterations",
}
# fmt: on
WORD = re.compile(r"[^\W_]+")  # letters and digits
BEFORE_A_CAPITAL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")  # valPSNR: val, PSNR
ONE_LESS = re.compile(r"(?<![^\W_])1\s*[-\N{MINUS SIGN}]\s*[^\W\d_]")  # 1 - ssim


def higher_is_better(metric: str) -> bool | None:
    """Whether higher values of a metric are better; None where its name does not say so.

    The name is taken apart into words, at what is no letter or digit and before a capital, so that
    `val1_psnr`, `test/psnr` and `lpips_vgg` are a PSNR, a PSNR and an LPIPS, and `val1_points` is
    no L1 error. One of the words has to be a known metric's; a number after it is allowed. Words
    that contradict each other (`ssim_loss`), or that change the meaning (`psnr_std`), make it
    unknown.

    Args:
        metric: a name as in the run logs.
    """
    if ONE_LESS.search(metric):
        return None
    words = [word.lower() for word in WORD.findall(BEFORE_A_CAPITAL.sub(" ", metric))]
    words = re.sub(r"\bd ssim\b", "dssim", " ".join(words)).split()
    found = {direction for word in words if (direction := _of_word(word)) is not None}
    if CHANGES_MEANING.intersection(words) or len(found) != 1:
        return None
    return found.pop()


def _of_word(word: str) -> bool | None:
    for name in (word, word.rstrip("0123456789")):  # l1; psnr2
        if name in HIGHER_IS_BETTER or name in LOWER_IS_BETTER:
            return name in HIGHER_IS_BETTER
    return None
