"""A pose without its length, in words and as plain values."""

from typing import Any

import numpy as np

from seamark.backend.epipolar import Direction
from seamark.frontend import se3


def direction_as_json(direction: Direction) -> dict[str, Any]:
    """Return it as plain values; ``bearing`` leads from the match's camera to the query's, in the match's frame."""
    return {
        "R_match_query": direction.R_match_query.tolist(),
        "bearing": direction.bearing.tolist(),
        "rotation_sigma_deg": float(np.rad2deg(direction.rotation_sigma)),
        "bearing_sigma_deg": float(np.rad2deg(direction.bearing_sigma)),
    }


def direction_facts(direction: Direction) -> list[tuple[str, str]]:
    """Return names and values: where the query lies as the match sees it (x right, y down, z ahead), and its turn."""
    turned = np.rad2deg(se3.rotation_angle(direction.R_match_query))
    x, y, z = direction.bearing
    bearing_sigma, rotation_sigma = np.rad2deg([direction.bearing_sigma, direction.rotation_sigma])
    return [
        ("query lies towards", f"{x:.2f} {y:.2f} {z:.2f} (+-{bearing_sigma:.1f} deg)"),
        ("turned by", f"{turned:.1f} (+-{rotation_sigma:.1f}) deg"),
    ]


def describe_direction(direction: Direction) -> str:
    """Return it in one line, as seen from the keyframe that the answer names."""
    (_, towards), (_, turned) = direction_facts(direction)
    return f"towards {towards}, turned by {turned}"
