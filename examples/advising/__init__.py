"""The pilots of `advise.py`: which trainings, how they run, what follows from them."""
