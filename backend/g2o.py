"""Pose graphs in g2o's text format: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT and EDGE_SE3:QUAT."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import GraphFileError
from seamark.frontend import se3

Matrix = NDArray[np.float64]

PLANAR_TAGS: Final = ("VERTEX_SE2", "EDGE_SE2")
SPATIAL_TAGS: Final = ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
MOTION_NUMBERS: Final = {"VERTEX_SE2": 3, "EDGE_SE2": 3, "VERTEX_SE3:QUAT": 7, "EDGE_SE3:QUAT": 7}
INFORMATION_NUMBERS: Final = {"EDGE_SE2": 6, "EDGE_SE3:QUAT": 21}
# The file's order is x y theta or x y z rx ry rz; ours is rotation first: where each of its axes lies in ours.
PLANAR_AXES: Final = (3, 4, 2)
SPATIAL_AXES: Final = (3, 4, 5, 0, 1, 2)
# A planar graph knows nothing of height, roll and pitch, and errs in none of them.
UNUSED_VARIANCE: Final = 1e-6
LARGEST_ID: Final = 2**62


@dataclass(frozen=True, eq=False)
class GraphFile:
    """A pose graph as read: N nodes, E edges.

    ``node_ids`` (N,) int64 ascending, ``T_vertex`` (N, 4, 4) the file's initial poses, NaN where it has none;
    ``from_ids to_ids`` (E,) int64, ``T_from_to`` (E, 4, 4), ``covariances`` (E, 6, 6) in the frame of ``to``, rotation
    first. ``planar``: SE2, lifted. ``ignored`` counts the lines of other kinds by their tag.
    """

    planar: bool
    node_ids: NDArray[np.int64]
    T_vertex: Matrix
    from_ids: NDArray[np.int64]
    to_ids: NDArray[np.int64]
    T_from_to: Matrix
    covariances: Matrix
    ignored: dict[str, int]


def read_g2o(path: Path) -> GraphFile:
    """Read a graph; raises GraphFileError, with the line, for anything that is no sound pose graph.

    Lines with tags of other kinds and comments are passed over. Where the file has vertices, edges may name no others.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise GraphFileError(f"{path} cannot be read: {error.strerror}") from error
    found: dict[str, list[tuple[int, list[str]]]] = {tag: [] for tag in (*PLANAR_TAGS, *SPATIAL_TAGS)}
    ignored: Counter[str] = Counter()
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in found:
            found[words[0]].append((number, words))
        else:
            ignored[words[0][:40]] += 1
    planar, spatial = (any(found[tag] for tag in tags) for tags in (PLANAR_TAGS, SPATIAL_TAGS))
    if planar and spatial:
        raise GraphFileError(f"{path} mixes planar and spatial poses")
    vertex_tag, edge_tag = PLANAR_TAGS if planar else SPATIAL_TAGS
    if not found[edge_tag]:
        raise GraphFileError(f"{path} has no EDGE_SE2 and no EDGE_SE3:QUAT")
    vertices, edges = _Table(path, vertex_tag, found[vertex_tag]), _Table(path, edge_tag, found[edge_tag])
    node_ids = _node_ids(path, vertices, edges)
    T_vertex = np.full((len(node_ids), 4, 4), np.nan)
    T_vertex[np.searchsorted(node_ids, vertices.ids[:, 0])] = vertices.motions()
    return GraphFile(
        planar=planar,
        node_ids=node_ids,
        T_vertex=T_vertex,
        from_ids=edges.ids[:, 0],
        to_ids=edges.ids[:, 1],
        T_from_to=edges.motions(),
        covariances=edges.covariances(),
        ignored=dict(ignored),
    )


class _Table:
    """The lines of one tag: ids (N, 1 or 2) and numbers (N, n), checked."""

    def __init__(self, path: Path, tag: str, lines: list[tuple[int, list[str]]]) -> None:
        self._path, self._tag = path, tag
        self.line_numbers = [number for number, _ in lines]
        self._ends = 2 if tag in INFORMATION_NUMBERS else 1
        wanted = MOTION_NUMBERS[tag] + INFORMATION_NUMBERS.get(tag, 0)
        for number, words in lines:
            if len(words) != 1 + self._ends + wanted:
                raise GraphFileError(
                    f"{path} line {number}: {tag} has {len(words) - 1} numbers where {self._ends + wanted} are needed"
                )
        self.ids = np.array(
            [[self._id(number, word) for word in words[1 : 1 + self._ends]] for number, words in lines], np.int64
        ).reshape(-1, self._ends)
        try:
            numbers = np.array([[float(word) for word in words[1 + self._ends :]] for _, words in lines])
        except ValueError:
            numbers = np.array([[_number(word) for word in words[1 + self._ends :]] for _, words in lines])
        self._numbers = numbers.reshape(-1, wanted)
        self._refuse(~np.isfinite(self._numbers).all(axis=1), "has a number that is none or not finite")

    def motions(self) -> Matrix:
        """Return the poses or motions (N, 4, 4)."""
        T = np.tile(np.eye(4), (len(self.ids), 1, 1))
        if self._tag in PLANAR_TAGS:
            x, y, theta = self._numbers[:, :3].T
            T[:, 0, 0] = T[:, 1, 1] = np.cos(theta)
            T[:, 1, 0] = np.sin(theta)
            T[:, 0, 1] = -T[:, 1, 0]
            T[:, 0, 3], T[:, 1, 3] = x, y
            return T
        quaternions = self._numbers[:, 3:7]
        self._refuse(np.abs(np.linalg.norm(quaternions, axis=1) - 1) > 0.01, "has a quaternion that is not of length 1")
        T[:, :3, :3] = se3.from_quaternion(quaternions)
        T[:, :3, 3] = self._numbers[:, :3]
        return T

    def covariances(self) -> Matrix:
        """Return the inverse information matrices (N, 6, 6), rotation first."""
        axes = PLANAR_AXES if self._tag in PLANAR_TAGS else SPATIAL_AXES
        size = len(axes)
        upper = self._numbers[:, MOTION_NUMBERS[self._tag] :]
        information = np.zeros((len(upper), size, size))
        information[:, *np.triu_indices(size)] = upper
        information += np.swapaxes(np.triu(information, 1), 1, 2)
        # Judged after scaling to a unit diagonal: units of metres and radians differ by orders of magnitude.
        diagonal = np.diagonal(information, axis1=1, axis2=2)
        positive = (diagonal > 0).all(axis=1)
        scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = information / scale[:, :, None] / scale[:, None, :]
        positive &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-12
        self._refuse(~positive, "has an information matrix that is not positive definite")
        inverse = np.linalg.inv(scaled) / scale[:, :, None] / scale[:, None, :]
        out = np.tile(np.eye(6) * UNUSED_VARIANCE, (len(upper), 1, 1))
        out[:, np.array(axes)[:, None], axes] = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
        return out

    def _id(self, number: int, word: str) -> int:
        try:
            value = int(word)
        except ValueError:
            value = -1
        if not 0 <= value < LARGEST_ID:
            raise GraphFileError(f"{self._path} line {number}: {word[:40]} is no node's number")
        return value

    def _refuse(self, wrong: NDArray[np.bool_], complaint: str) -> None:
        if wrong.any():
            number = self.line_numbers[int(np.argmax(wrong))]
            raise GraphFileError(f"{self._path} line {number}: {self._tag} {complaint}")


def _node_ids(path: Path, vertices: _Table, edges: _Table) -> NDArray[np.int64]:
    """Return all nodes, ascending; refuse nodes given twice, edges to unknown ones and edges from one to itself."""
    for number, (a, b) in zip(edges.line_numbers, edges.ids.tolist(), strict=True):
        if a == b:
            raise GraphFileError(f"{path} line {number}: the edge joins node {a} with itself")
    if len(vertices.ids) == 0:
        return np.unique(edges.ids)
    ids, counts = np.unique(vertices.ids, return_counts=True)
    if (counts > 1).any():
        raise GraphFileError(f"{path} gives node {ids[counts > 1][0]} more than once")
    unknown = ~np.isin(edges.ids, ids)
    if unknown.any():
        row = int(np.argmax(unknown.any(axis=1)))
        raise GraphFileError(
            f"{path} line {edges.line_numbers[row]}: the edge names node {edges.ids[unknown][0]}, which has no vertex"
        )
    return ids


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")
