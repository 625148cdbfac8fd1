"""The ways that trajectories take, in blocks between teleports: x, y, z (m) and heading (rad) at every tick."""

import itertools

import numpy as np

from seamark import SeamarkError
from seamark.datasets_synth import course
from seamark.datasets_synth.course import TICK_S, Array, Limits
from seamark.datasets_synth.route import Route

MOST_LANES = 4
STAND_AFTER_M, STAND_S = 1.6, 30.0
EIGHT_INSIDE, MOWER_INSIDE = 0.5, 0.65  # how much of the extent of a closed route ways use that leave it


def _overlap_m(route: Route) -> float:
    """Return how far a lap goes on after it has closed."""
    length = float(np.linalg.norm(np.diff(route.waypoints, axis=0, append=route.waypoints[:1]), axis=1).sum())
    return max(4.0, 0.06 * length)


def once(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Once along the route."""
    return [course.drive(course.lap(route), limits)]


def loop(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Once round and a little more."""
    _require_closed(route, "loop")
    return [course.drive(course.lap(route, _overlap_m(route)), limits)]


def once_round(route: Route, limits: Limits, rng: np.random.Generator) -> list[Array]:
    """Once round, or along where the route does not close."""
    return (loop if route.closed else once)(route, limits, rng)


def figure_eight(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """The second half of the corners in reverse order: the way crosses itself in the middle."""
    _require_closed(route, "figure_eight")
    half = (len(route.waypoints) + 1) // 2
    corners = _inside(route, EIGHT_INSIDE)
    crossed = np.concatenate([corners[:half], corners[half:][::-1]])
    eight = Route(route.name, crossed, True, route.corner_radius_m, route.speed_m_s)
    return [course.drive(course.lap(eight, _overlap_m(eight)), limits)]


def there_and_back(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """To the end of an open route, half round a closed one."""
    path = course.part(course.lap(route), 0, 0.5 if route.closed else 1)
    there = course.drive(path, limits)
    around = course.turn(there, np.pi, limits)
    return [course.joined([there, around, course.drive(path[::-1], limits)])]


def lawn_mower(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Lanes across the area that a closed route encloses; along an open route, lanes side by side."""
    if not route.closed:
        path = course.lap(route)
        pieces = [course.drive(course.aside(path, -0.6 * route.clearance_m), limits)]
        for lane, offset in enumerate((0.0, 0.6 * route.clearance_m)):
            way = course.aside(path, offset)
            pieces.append(course.turn(pieces[-1], np.pi, limits))
            pieces.append(course.drive(way if lane % 2 else way[::-1], limits))
        return [_bridged(pieces, limits)]
    area = _inside(route, MOWER_INSIDE)
    low, high = area.min(axis=0), area.max(axis=0)
    across = int(np.argmin((high - low)[:2]))
    lanes = round(float((high - low)[across]) / max(0.8, 2 * route.clearance_m)) + 1
    count = min(MOST_LANES, max(3, lanes))
    corners = []
    for lane, at in enumerate(np.linspace(low[across], high[across], count)):
        for end in (low, high) if lane % 2 == 0 else (high, low):
            corner = np.array([end[0], end[1], route.waypoints[0, 2]])
            corner[across] = at
            corners.append(corner)
    radius = min(route.corner_radius_m, 0.4 * float((high - low)[across]) / (count - 1))
    mower = Route(route.name, np.stack(corners), False, radius, route.speed_m_s)
    return [course.drive(course.lap(mower), limits)]


def _inside(route: Route, share: float) -> Array:
    """Return the corners (N, 3) of a closed route drawn together about their middle, at their height."""
    middle = route.waypoints.mean(axis=0)
    return np.asarray(middle + np.array([share, share, 1.0]) * (route.waypoints - middle))


def _bridged(pieces: list[Array], limits: Limits) -> Array:
    """Return the pieces joined, with short drives sideways wherever one begins beside the end of the last."""
    out = [pieces[0]]
    for piece in pieces[1:]:
        gap = np.linalg.norm(piece[0, :3] - out[-1][-1, :3])
        if gap > 1e-6:
            f = np.linspace(0, 1, max(8, int(1.875 * gap / (0.3 * limits.speed_m_s) / TICK_S)))[:, None]
            shift = np.repeat(out[-1][-1:], len(f), axis=0)
            shift[:, :3] += (10 * f**3 - 15 * f**4 + 6 * f**5) * (piece[0, :3] - out[-1][-1, :3])
            out.append(shift)
        out.append(piece)
    return course.joined(out)


def stop_and_go(route: Route, limits: Limits, rng: np.random.Generator) -> list[Array]:
    """Once round with five stops at drawn places."""
    path = course.lap(route, _overlap_m(route))
    stops = np.concatenate([[0], np.arange(1, 6) / 6 + rng.uniform(-0.05, 0.05, 5), [1]])
    pieces: list[Array] = []
    for start, end in itertools.pairwise(stops.tolist()):
        pieces.append(course.drive(course.part(path, start, end), limits))
        pieces.append(course.pause(pieces[-1], rng.uniform(1.0, 2.5)))
    return [course.joined(pieces)]


def standing(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Drive so that a map can begin, stand still for long, drive on."""
    path = course.lap(route)
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    first, end = (min(share, metres / length) for share, metres in ((0.3, STAND_AFTER_M), (0.6, 2 * STAND_AFTER_M)))
    pieces = [course.drive(course.part(path, 0, first), limits)]
    pieces.append(course.pause(pieces[-1], STAND_S))
    pieces.append(course.drive(course.part(path, first, end), limits))
    return [course.joined(pieces)]


def pure_rotation(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Drive so that a map can begin, turn once round about the optical centre, drive on, turn once round back."""
    path = course.lap(route)
    pieces = [course.drive(course.part(path, 0, 0.2), limits)]
    for start, end, angle in ((0.2, 0.4, 2 * np.pi), (0.4, 0.5, -2 * np.pi)):
        pieces.append(course.turn(pieces[-1], angle, limits))
        pieces.append(course.drive(course.part(path, start, end), limits))
    return [course.joined(pieces)]


def kidnap(route: Route, limits: Limits, _: np.random.Generator) -> list[Array]:
    """Carried ahead to a place not seen yet, then back to one that has been seen; stamps go on."""
    path = course.lap(route, _overlap_m(route))
    shares = ((0.0, 0.4), (0.7, 1.0), (0.2, 0.45))
    return [course.drive(course.part(path, *share), limits) for share in shares]


def second_traversal(route: Route, limits: Limits, rng: np.random.Generator) -> list[Array]:
    """The same way, up to 0.35 m aside and looking up to 6 degrees aside, changing slowly."""
    room = min(0.35, 0.6 * route.clearance_m)
    path = course.lap(route, _overlap_m(route))
    side = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 0.8) * room
    piece = course.drive(course.aside(path, side), limits)
    waves = np.sin(2 * np.pi * np.arange(len(piece)) * TICK_S / rng.uniform(11, 17) + rng.uniform(0, 2 * np.pi))
    piece[:, 3] += np.deg2rad(rng.choice([-1.0, 1.0]) * rng.uniform(2, 4) + 2 * waves)
    return [piece]


def _require_closed(route: Route, kind: str) -> None:
    if not route.closed:
        raise SeamarkError(f"route {route.name} does not come back to its start, so there is no {kind} along it")
