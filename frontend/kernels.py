"""The C++ kernels, or a sentence that says why they are not there."""

from seamark import SeamarkError


class KernelsMissingError(SeamarkError):
    """The compiled part of the front end is missing."""


try:
    from seamark.frontend import _native as native
except ImportError as error:
    raise KernelsMissingError(
        f"the compiled part of Seamark is missing or does not fit this Python ({error}): "
        "run `make setup` in a checkout, or install the wheel"
    ) from error

__all__ = ["KernelsMissingError", "native"]
