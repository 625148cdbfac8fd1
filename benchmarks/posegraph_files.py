"""Pose graphs for the back end's benchmarks: real ones, false loops of many kinds put into them, and generated ones."""

from pathlib import Path

import numpy as np

from seamark.backend.g2o import GraphFile, read_g2o
from seamark.frontend import se3

TRUE_WITHIN_M = 5.0
KINDS = ("random", "lone", "groups", "long_groups", "identity", "near", "near_groups")


def truth_of(path):
    """Return the true poses (N, 4, 4) of a file whose consecutive edges are the true motions."""
    graph = read_g2o(path)
    poses = [np.eye(4)]
    for T in graph.T_from_to:
        poses.append(poses[-1] @ T)
    return np.array(poses)


def true_edges(graph, truth):
    """Return which edges (E,) join nodes that truly are near to each other."""
    a, b = truth[graph.from_ids, :3, 3], truth[graph.to_ids, :3, 3]
    return np.linalg.norm(a - b, axis=1) < TRUE_WITHIN_M


def ate(T, truth):
    """Return the RMSE of positions after SE(3) alignment."""
    a, b = T[:, :3, 3], truth[: len(T), :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, _, Vt = np.linalg.svd(b0.T @ a0)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(((b0 - a0 @ R.T) ** 2).sum(1).mean()))


def pose(rng, metres, radians, planar=True):
    """Return a random motion: normal translation and rotation."""
    w, t = rng.normal(0, radians, 3), rng.normal(0, metres, 3)
    if planar:
        w[:2] = 0
        t[2] = 0
    return se3.make(se3.exp_rotation(w), t)


def false_loops(kind, count, truth, rng, planar=True):
    """Return (from, to, T_from_to) of loops that are all wrong: their ends are at least 10 m apart, or their pose is.

    ``random``: any pose. ``lone``: any pose, never two near to each other. ``groups``: 4 to 9 that agree, a wrong place
    seen for a while; ``long_groups``: 10 to 25. ``identity``: groups that say "exactly here" all the time. ``near`` and
    ``near_groups``: right places, 6 to 20 m off, singly and in groups.
    """
    N, out = len(truth), []
    while len(out) < count:
        size = {"groups": rng.integers(4, 10), "near_groups": rng.integers(4, 10), "identity": rng.integers(4, 10)}
        n = int(size.get(kind, 1)) if kind != "long_groups" else int(rng.integers(10, 26))
        q, m, stride = int(rng.integers(100, N - 80)), int(rng.integers(0, N - 180)), 3
        if m + 100 > q:
            continue
        base = pose(rng, 2.0, 0.1, planar)
        if kind in ("random", "lone"):
            base = pose(rng, 7.0, 2.0, planar)
        if kind.startswith("near"):
            distances = np.linalg.norm(truth[: q - 100, :3, 3] - truth[q, :3, 3], axis=1)
            m = int(np.argmin(distances))
            turn = rng.uniform(0, 2 * np.pi)
            offset = rng.uniform(6, 20) * np.array([np.cos(turn), np.sin(turn), 0])
            base = np.linalg.inv(truth[m]) @ truth[q] @ se3.make(np.eye(3), offset)
            if distances[m] > 50:
                continue
        elif np.linalg.norm(truth[q, :3, 3] - truth[m, :3, 3]) < 25:
            continue
        if kind == "lone" and any(abs(q - x[0]) < 25 for x in out):
            stride = 0
            if len(out) > N // 60:
                break
            continue
        for k in range(0, n * stride, stride):
            if q + k >= N or m + k >= q:
                break
            T = np.linalg.inv(truth[m + k]) @ truth[m] @ base @ np.linalg.inv(truth[q]) @ truth[q + k]
            T = T @ pose(rng, 0.1, 0.01, planar)
            out.append((m + k, q + k, np.eye(4) if kind == "identity" else T))
    return out[:count]


def with_false_loops(graph, truth, kind, seed, share=0.7):
    """Return the graph with its own false loops replaced by seeded ones, ``share`` of all loops, and which are true."""
    rng = np.random.default_rng(seed)
    odometry = graph.to_ids == graph.from_ids + 1
    sound = odometry | true_edges(graph, truth)
    count = int((sound & ~odometry).sum() * share / (1 - share))
    false = false_loops(kind, count, truth, rng, graph.planar)
    T = np.stack([x[2] for x in false])
    merged = GraphFile(
        planar=graph.planar,
        node_ids=graph.node_ids,
        T_vertex=graph.T_vertex,
        from_ids=np.concatenate([graph.from_ids[sound], [x[0] for x in false]]),
        to_ids=np.concatenate([graph.to_ids[sound], [x[1] for x in false]]),
        T_from_to=np.concatenate([graph.T_from_to[sound], T]),
        covariances=np.concatenate([graph.covariances[sound], np.repeat(graph.covariances[:1], len(T), axis=0)]),
        ignored={},
    )
    false_pairs = {(x[0], x[1]) for x in false}
    return merged, false_pairs


def lifted(graph, truth, rng):
    """Return a planar graph and its truth as spatial ones: the road climbs and banks, odometry errs in six axes."""
    N = len(truth)
    phase = np.arange(N) / 400
    T_up = np.array(
        [
            se3.make(
                se3.exp_rotation(np.array([0.05 * np.sin(p), 0.05 * np.cos(2 * p), 0])), np.array([0, 0, 3 * np.sin(p)])
            )
            for p in phase
        ]
    )
    bent = truth @ T_up
    flat = np.linalg.inv(truth[graph.from_ids]) @ truth[graph.to_ids]
    errors = np.linalg.inv(flat) @ graph.T_from_to  # the real errors in the plane, kept
    motions = np.linalg.inv(bent[graph.from_ids]) @ bent[graph.to_ids] @ errors
    covariances = graph.covariances.copy()
    for axis, sigma in ((0, 0.0005), (1, 0.0005), (5, 0.02)):
        covariances[:, axis, axis] = sigma**2
    noise = np.array(
        [
            se3.make(se3.exp_rotation(np.array([*rng.normal(0, 0.0005, 2), 0])), [0, 0, rng.normal(0, 0.02)])
            for _ in motions
        ]
    )
    return (
        GraphFile(
            planar=False,
            node_ids=graph.node_ids,
            T_vertex=np.full((N, 4, 4), np.nan),
            from_ids=graph.from_ids,
            to_ids=graph.to_ids,
            T_from_to=motions @ noise,
            covariances=covariances,
            ignored={},
        ),
        bent,
    )


def kitti(folder: Path, name):
    """Return the graph and the true poses of one KITTI sequence's folder."""
    truth = truth_of(folder / f"kitti_{folder.name}_GT.g2o")
    return read_g2o(folder / f"kitti_{folder.name}_{name}.g2o"), truth


def sphere(rings, per_ring):
    """Return true poses on a sphere of 50 m and the loops from each node to the one a ring below."""
    k = np.arange(rings * per_ring)
    height = np.pi * (k / len(k) * 0.9 + 0.05)
    around = 2 * np.pi * k / per_ring
    points = 50 * np.stack([np.sin(height) * np.cos(around), np.sin(height) * np.sin(around), np.cos(height)], axis=1)
    return _along(points, points), [(i - per_ring, i) for i in k[per_ring:].tolist()]


def torus(rings, per_ring):
    """Return true poses on a torus and the loops from each node to the one a ring before."""
    k = np.arange(rings * per_ring)
    u, v = 2 * np.pi * k / per_ring, 2 * np.pi * k / len(k)
    points = np.stack([(30 + 10 * np.cos(u)) * np.cos(v), (30 + 10 * np.cos(u)) * np.sin(v), 10 * np.sin(u)], axis=1)
    centre = 30 * np.stack([np.cos(v), np.sin(v), 0 * v], axis=1)
    return _along(points, points - centre), [(i - per_ring, i) for i in k[per_ring:].tolist()]


def city(nodes, street, rng, every=5, side=12):
    """Return true planar poses of a drive through a square city and loops where a street is driven again."""
    directions = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    corner, heading, truth, loops, seen = np.zeros(2, int), 0, [], [], {}
    while len(truth) < nodes:
        for step in range(street):
            position = corner * street + directions[heading] * step
            turn = se3.exp_rotation(np.array([0, 0, heading * np.pi / 2]))
            k = len(truth)
            truth.append(se3.make(turn, np.array([*position, 0.0])))
            before = seen.setdefault(tuple(position), k)
            if k - before > 50 and k % every == 0:
                loops.append((before, k))
        corner = corner + directions[heading]
        ways = [(heading + turn) % 4 for turn in (-1, 0, 1)]
        ways = [w for w in ways if (corner + directions[w] >= 0).all() and (corner + directions[w] <= side).all()]
        heading = int(rng.choice(ways))
    return np.array(truth[:nodes]), [pair for pair in loops if pair[1] < nodes]


def measured(truth, loops, rng, planar, metres, radians):
    """Return the graph that odometry and loops of this noise measure; the noise is as the covariances say."""
    pairs = [(k, k + 1) for k in range(len(truth) - 1)] + list(loops)
    a, b = np.array(pairs).T
    T = np.linalg.inv(truth[a]) @ truth[b]
    T = T @ np.array([pose(rng, metres, radians, planar) for _ in pairs])
    sigmas = np.array([radians] * 3 + [metres] * 3)
    if planar:
        sigmas[[0, 1, 5]] = 1e-3
    return GraphFile(
        planar=planar,
        node_ids=np.arange(len(truth)),
        T_vertex=np.full((len(truth), 4, 4), np.nan),
        from_ids=a,
        to_ids=b,
        T_from_to=T,
        covariances=np.repeat(np.diag(sigmas**2)[None], len(pairs), axis=0),
        ignored={},
    )


def _along(points, up):
    """Return poses that look along a curve."""
    forward = np.gradient(points, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    out = np.tile(np.eye(4), (len(points), 1, 1))
    out[:, :3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=2)
    out[:, :3, 3] = points
    return out
