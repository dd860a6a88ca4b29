"""Fading as it was before the number of points counted."""

from opt3dgs_optim import Fading


class ShareKept(Fading):
    """`Fading` of the same share of the points as often, however many they are."""

    def happens(self, event: int, num_points: int) -> bool:
        """Always."""
        return num_points > 0
