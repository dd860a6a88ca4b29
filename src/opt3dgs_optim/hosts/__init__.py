"""The package in other people's trainers: which lines, and where they go."""
