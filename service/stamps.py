"""Stamps in text: integer nanoseconds in and out, never through a float."""

from decimal import Decimal, InvalidOperation

NANOSECONDS = 1_000_000_000
# 146 years: room enough for sums and differences in 64 bits.
MAX_STAMP_NS = 2**62


def format_stamp(stamp_ns: int) -> str:
    """Return the stamp in seconds with exactly nine decimals."""
    seconds, rest = divmod(abs(int(stamp_ns)), NANOSECONDS)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest:09d}"


def parse_stamp(text: str) -> int:
    """Return the nanoseconds of a number of seconds in decimal or scientific notation; raises ValueError."""
    try:
        stamp_ns = int((Decimal(text) * NANOSECONDS).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f"{text!r} is not a stamp in seconds") from error
    if abs(stamp_ns) > MAX_STAMP_NS:
        raise ValueError(f"{text} s is beyond the stamps that can be told")
    return stamp_ns


def running_stamp(index: int, fps: float) -> int:
    """Return the stamp of image ``index`` of a sequence that has ``fps`` images per second and starts at zero."""
    return round(index * NANOSECONDS / fps)
