"""The answer to a place query says what it is worth: accepted, doubt between equals, or "nothing here" and why."""

import numpy as np
import pytest

from seamark.backend.types import Place, Reason
from seamark.frontend import se3
from seamark.service.nodes.places import judge
from seamark.service.query import as_json
from seamark.service.requests import PlaceReply
from seamark.vocab.confidence import Verdict


def place(inliers: int, reason: Reason = Reason.ACCEPTED, x: float = 0.0, yaw_deg: float = 0.0) -> Place:
    half = np.deg2rad(yaw_deg)
    turn = np.array([[np.cos(half), -np.sin(half), 0], [np.sin(half), np.cos(half), 0], [0, 0, 1]])
    pose = se3.make(turn, np.array([x, 0.0, 0.0])) if reason == Reason.ACCEPTED else None
    return Place(1, 0, 0, "a", 0.5, 0.1, 0.1, inliers, reason == Reason.ACCEPTED, reason, pose, 0.5, 0.9)


@pytest.mark.parametrize(
    ("places", "verdict"),
    [
        ([], Verdict.FEW_INLIERS),
        ([place(7, Reason.UNCONFIRMED)], Verdict.FEW_INLIERS),
        ([place(8, Reason.UNCONFIRMED)], Verdict.UNSURE),
        ([place(100)], Verdict.ACCEPTED),
        ([place(100), place(90, x=2.0)], Verdict.ACCEPTED),  # neighbours of one place agree on where the camera is
        ([place(100), place(90, x=5.0)], Verdict.DOUBT),
        ([place(100), place(90, yaw_deg=180.0)], Verdict.DOUBT),  # the other one of two twins
        ([place(100), place(49, x=5.0)], Verdict.ACCEPTED),  # not nearly as good
        ([place(100), place(90, Reason.UNCONFIRMED)], Verdict.ACCEPTED),
    ],
)
def test_verdict_of_an_answer(places: list[Place], verdict: Verdict) -> None:
    assert judge(places) is verdict


def test_the_answer_as_json_has_the_verdict_and_the_evidence() -> None:
    found = as_json(PlaceReply((place(100),), verdict=Verdict.DOUBT))
    assert found["verdict"] == "doubt"
    assert found["places"][0]["view"] == 0.5 and found["places"][0]["probability"] == 0.9
    assert as_json(PlaceReply())["verdict"] is None
