"""Parts of the study's own, each in a file of its own."""
