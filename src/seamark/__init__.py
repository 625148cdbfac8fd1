"""Seamark: a place-recognition and visual-SLAM service for the CPU.

The rooms are sub-packages: ``frontend`` (images to odometry and keyframes), ``vocab`` (descriptors to places),
``backend`` (places to a consistent map), ``service`` (everything that talks) and ``datasets_synth`` (worlds with ground
truth). Conventions of frames, stamps and units are written in :mod:`seamark.frontend.types`.
"""

from importlib.metadata import version

__all__ = ["SeamarkError", "__version__"]

__version__ = version("seamark")


class SeamarkError(Exception):
    """Root of every error that bad input or a bad environment causes; its text is meant for the user."""
