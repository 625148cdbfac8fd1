"""The picture of one loop: both images side by side with their matches, what was tested, and what became of it."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from seamark.backend.evidence import Evidence
from seamark.backend.explain import Explanation
from seamark.frontend.types import Keyframe
from seamark.service.directions import direction_facts
from seamark.service.picture import ACCEPTED, DPI, GREY, INK

REFUSED = "#dc2626"
MISSING = "#f59e0b"
WIDTH_IN = 12.0
GAP = 0.02  # between the images, per width
LINE_IN = 0.19
MOST_HISTORY = 8


def draw_explanation(found: Explanation, path: Path) -> None:
    """Write the picture as PNG."""
    images = [_image(keyframe) for keyframe in (found.query, found.match)]
    height = max(image.shape[0] for image in images)
    gap = int(GAP * images[0].shape[1])
    width = images[0].shape[1] + gap + images[1].shape[1]
    lines = max(len(found.evidence.gates) if found.evidence else 0, 11 + min(len(found.history), MOST_HISTORY)) + 3
    picture_in, text_in = WIDTH_IN * height / width, LINE_IN * lines
    figure = Figure(figsize=(WIDTH_IN, picture_in + text_in + 0.75))
    FigureCanvasAgg(figure)
    total = picture_in + text_in + 0.75
    axes = figure.add_axes((0.01, text_in / total, 0.98, picture_in / total))
    _draw_images(axes, images, gap)
    if found.evidence is not None:
        _draw_matches(axes, found.evidence, images[0].shape[1] + gap)
    verdict = "accepted" if found.loop.accepted else f"refused: {found.loop.reason}"
    colour = ACCEPTED if found.loop.accepted else REFUSED
    top = 1 - 0.3 / total
    figure.text(0.01, top, f"loop {found.loop.query_id}-{found.loop.match_id}", color=INK, size=13, weight="bold")
    figure.text(0.15, top, verdict, color=colour, size=13, weight="bold")
    figure.text(0.01, top - 0.3 / total, _name("query", found.query), color=INK, size=8.5)
    figure.text(0.5, top - 0.3 / total, _name("match", found.match), color=INK, size=8.5)
    _write_gates(figure, found, text_in / total, total)
    _write_rest(figure, found, text_in / total, total)
    figure.savefig(path, format="png", dpi=DPI, facecolor="white", metadata={"Software": "Seamark"})


def _image(keyframe: Keyframe) -> NDArray[np.uint8]:
    """Return the keyframe's picture in RGB; grey where it has been pruned or cannot be decoded."""
    decoded = cv2.imdecode(np.frombuffer(keyframe.jpeg, np.uint8), cv2.IMREAD_COLOR) if keyframe.jpeg else None
    if decoded is not None:
        return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB))
    camera = keyframe.camera
    size = (480, 640) if camera is None else (camera.height, camera.width)
    return np.full((*size, 3), 210, np.uint8)


def _name(role: str, keyframe: Keyframe) -> str:
    stamp = f"{1e-9 * keyframe.stamp_ns:.3f} s"
    return f"{role}: keyframe {keyframe.id} of session {keyframe.session}, frame {keyframe.index}, {stamp}"


def _draw_images(axes: Axes, images: list[NDArray[np.uint8]], gap: int) -> None:
    left = 0
    for image in images:
        rows, columns = image.shape[:2]
        axes.imshow(image, extent=(left - 0.5, left + columns - 0.5, rows - 0.5, -0.5), interpolation="lanczos")
        left += columns + gap
    axes.set_xlim(-0.5, left - gap - 0.5)
    axes.set_ylim(max(image.shape[0] for image in images) - 0.5, -0.5)
    axes.axis("off")


def _draw_matches(axes: Axes, evidence: Evidence, offset: int) -> None:
    ends = evidence.pixels.reshape(-1, 2, 2) + np.array([[0, 0], [offset, 0]], np.float32)
    for chosen, colour, alpha in ((~evidence.inliers, REFUSED, 0.45), (evidence.inliers, ACCEPTED, 0.5)):
        axes.add_collection(LineCollection(list(ends[chosen]), colors=colour, linewidths=0.7, alpha=alpha))
        points = ends[chosen].reshape(-1, 2)
        axes.plot(points[:, 0], points[:, 1], ".", color=colour, ms=2.5, alpha=0.9)
    missing = evidence.missing
    axes.plot(missing[:, 0], missing[:, 1], "o", mfc="none", mec=MISSING, ms=4, mew=0.7)


def _write_gates(figure: Figure, found: Explanation, top: float, total: float) -> None:
    evidence = found.evidence
    step, y = LINE_IN / total, top - 1.4 * LINE_IN / total
    if evidence is None:
        figure.text(0.01, y, "its evidence was not kept, and its features have been pruned", color=GREY, size=9)
        return
    inliers = int(evidence.inliers.sum())
    figure.text(
        0.01,
        y,
        f"green: {inliers} of {len(evidence.pixels)} matches that the geometry explains",
        color=ACCEPTED,
        size=8.5,
    )
    if len(evidence.missing):
        text = f"rings: {len(evidence.missing)} landmarks of the match, expected and not seen"
        figure.text(0.01, y - step, text, color=MISSING, size=8.5)
    y -= 2.3 * step
    for gate in evidence.gates:
        colour = ACCEPTED if gate.passed else REFUSED
        figure.text(0.01, y, "passed" if gate.passed else "failed", color=colour, size=8.5, weight="bold")
        figure.text(0.07, y, gate.name.replace("_", " "), color=INK, size=8.5)
        relation = "at least" if gate.least else "at most"
        figure.text(0.32, y, f"{gate.value:.4g}", color=INK, size=8.5)
        figure.text(0.385, y, f"{relation} {gate.limit:.4g}", color=GREY, size=8.5)
        y -= step


def _write_rest(figure: Figure, found: Explanation, top: float, total: float) -> None:
    step, y = LINE_IN / total, top - 1.4 * LINE_IN / total
    for name, value in facts_of(found):
        figure.text(0.5, y, name, color=GREY, size=8.5)
        figure.text(0.68, y, value, color=INK, size=8.5)
        y -= step


def facts_of(found: Explanation) -> list[tuple[str, str]]:
    """Return what there is to say besides gates, as names and values; the newest of the history comes last."""
    loop = found.loop
    rows = [
        ("score of the place index", f"{loop.score:.3f}: votes {loop.votes:.3f}, Jeffrey {loop.jeffrey:.3f}"),
        ("inliers of the pose", str(loop.inliers)),
    ]
    if found.evidence is not None and np.isfinite(found.evidence.reprojection_px):
        rows.append(("median error", f"{found.evidence.reprojection_px:.2f} px"))
    if found.evidence is not None and found.evidence.direction is not None:
        rows += direction_facts(found.evidence.direction)
    if loop.T_match_query is not None:
        x, y, z = loop.T_match_query[:3, 3]
        rows.append(("query in the match's frame", f"x {x:.3f}, y {y:.3f}, z {z:.3f}"))
    if loop.covariance is not None:
        sigma = np.sqrt(np.clip(np.diag(loop.covariance), 0, None))
        rotation = np.rad2deg(np.linalg.norm(sigma[:3]))
        rows.append(("its deviation", f"{rotation:.3f} degrees, {np.linalg.norm(sigma[3:]):.4f}"))
    if loop.scale != 1.0:
        rows.append(("scale", f"{loop.scale:.4f} match units per query unit"))
    if found.error is not None and found.chi2 is not None and found.weight is not None:
        angle, distance = np.rad2deg(np.linalg.norm(found.error[:3])), np.linalg.norm(found.error[3:])
        rows.append(("the map differs by", f"{angle:.3f} degrees, {distance:.4f}; chi squared {found.chi2:.2f}"))
        rows.append(("weight today", f"{found.weight:.3f}"))
    rows.append(("evidence", str(found.source)))
    entries = found.history[-MOST_HISTORY:]
    rows.append(("verdicts so far", str(len(found.history)) if found.history else "none was kept"))
    for entry in entries:
        rows.append((f"at keyframe {entry.newest_keyframe_id}", f"{entry.reason} (revision {entry.revision})"))
    return rows
