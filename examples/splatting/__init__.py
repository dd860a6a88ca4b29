"""A minimal Gaussian splatting trainer for the examples; not part of the installed package."""
