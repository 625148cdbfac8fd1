"""A bug that a peer triggers again and again is told in full once, and then counted."""

import logging

import pytest

from seamark.service.repeated_errors import MOST_KINDS, RepeatedErrors


def fails(value: int) -> None:
    raise ValueError(f"bad {value}")


def fails_elsewhere() -> None:
    raise ValueError("bad 0")


def test_a_flood_of_one_error_is_one_traceback_and_a_line_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    errors = RepeatedErrors(logging.getLogger("flood"), every_s=60.0, clock=lambda: now[0])
    for number in range(1000):
        now[0] = 0.15 * number  # 150 s
        try:
            fails(number)
        except ValueError as error:
            errors.log("a handler failed", error)
    assert len(caplog.records) == 3 and [record.exc_info is not None for record in caplog.records] == [
        True,
        False,
        False,
    ]
    assert [record.getMessage() for record in caplog.records] == [
        "a handler failed",
        "a handler failed 400 times more: ValueError: bad 400",
        "a handler failed 400 times more: ValueError: bad 800",
    ]


def test_other_errors_are_told_in_full_however_many_there_are(caplog: pytest.LogCaptureFixture) -> None:
    errors = RepeatedErrors(logging.getLogger("flood"), clock=lambda: 0.0)
    for cause in (fails_elsewhere, lambda: fails(0), lambda: fails(1)):
        try:
            cause()
        except ValueError as error:
            errors.log("a handler failed", error)
    errors.log("a handler failed", KeyError("never raised"))
    assert [record.exc_info is not None for record in caplog.records] == [True] * 3  # fails(1) was the same as fails(0)
    for number in range(2 * MOST_KINDS):
        errors.log("a handler failed", type(f"Error{number}", (Exception,), {})())
    assert len(caplog.records) == 3 + 2 * MOST_KINDS
