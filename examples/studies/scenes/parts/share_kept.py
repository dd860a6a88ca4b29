"""Fading as it was before the number of points counted."""

from opt3dgs_optim import Fading


class ShareKept(Fading):
    """`Fading` of the same share of the points, however many they are."""

    def share_of(self, num_points: int) -> float:
        """`share`."""
        return self.share
