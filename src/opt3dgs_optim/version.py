"""The installed version, which the build takes from git's tags."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("opt3dgs_optim")
except PackageNotFoundError:  # a checkout on the path that was never installed
    __version__ = "0+unknown"
