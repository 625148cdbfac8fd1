"""Camera motions along the route of a world: what they are called, and the limits that they keep."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import ways
from seamark.datasets_synth.course import TICK_S, Array, Limits
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.spline import UniformSpline
from seamark.frontend import se3

SMOOTHING_S = 0.12  # sigma of the Gaussian over time that rounds changes of acceleration
RESERVE = 0.92  # of the limits is used for driving, the rest is for sway and jitter
CHECK_S = 0.01
WAVES_M = np.array([7.3, 5.9, 4.7, 6.7, 8.9])  # lengths of the sway over the way travelled
SWAY = np.array([0.05, 0.015, np.deg2rad(2.0), np.deg2rad(1.2), np.deg2rad(0.8)])  # side, lift, yaw, pitch, roll


@dataclass(frozen=True)
class Shake:
    """Smooth random motion on top of a course: amplitudes (one sigma of a sum of sines) between two frequencies.

    ``side_m`` and ``lift_m`` move, ``yaw_rad``, ``pitch_rad`` and ``roll_rad`` turn.
    """

    side_m: float
    lift_m: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    slowest_hz: float
    fastest_hz: float

    def waves(self, rng: np.random.Generator, times: Array) -> Array:
        """Return (N, 5) offsets at ``times`` (N,): side, lift, yaw, pitch, roll."""
        frequencies = rng.uniform(self.slowest_hz, self.fastest_hz, (4, 5))
        phases = rng.uniform(0, 2 * np.pi, (4, 5))
        sines = np.sin(2 * np.pi * times[:, None, None] * frequencies + phases).sum(axis=1) / np.sqrt(2)
        sizes = np.array([self.side_m, self.lift_m, self.yaw_rad, self.pitch_rad, self.roll_rad])
        return np.asarray(sines * sizes)


@dataclass(frozen=True)
class Kind:
    """How a motion is made: the blocks between teleports, shake, and limits relative to those of the route."""

    description: str
    blocks: Callable[[Route, Limits, np.random.Generator], list[Array]]
    shake: Shake | None = None
    speed_factor: float = 1.0
    acceleration_m_s2: float = 1.2
    turn_rad_s: float = 0.9
    leaves_route: bool = False


HAND = Shake(0.012, 0.012, np.deg2rad(1.0), np.deg2rad(0.9), np.deg2rad(0.9), 0.4, 2.2)
FLIGHT = Shake(0.06, 0.12, np.deg2rad(7), np.deg2rad(6), np.deg2rad(6), 0.05, 0.3)
KINDS: dict[str, Kind] = {
    "loop": Kind("once round and a little more", ways.loop),
    "once": Kind("from one end to the other", ways.once),
    "figure_eight": Kind("a way that crosses itself; needs an open area", ways.figure_eight, leaves_route=True),
    "there_and_back": Kind("to the end or half round, about turn, back in the opposite direction", ways.there_and_back),
    "lawn_mower": Kind("lanes side by side in alternating directions", ways.lawn_mower, leaves_route=True),
    "hand_held": Kind("once round with the jitter of a hand", ways.once_round, HAND, 1.3, 4.0, 1.5),
    "six_dof": Kind("once round, rising, sinking, nodding and rolling", ways.once_round, FLIGHT, 1.3, 2.0, 1.2),
    "stop_and_go": Kind("once round with five stops", ways.stop_and_go),
    "standing": Kind("drive for a moment, stand still for half a minute, drive on", ways.standing),
    "pure_rotation": Kind("drive, turn once round on the spot, twice", ways.pure_rotation),
    "kidnap": Kind("carried away twice, in no time", ways.kidnap),
    "second_traversal": Kind("once round again, aside and looking aside", ways.second_traversal),
}


def limits(kind: str, route: Route) -> Limits:
    """Return what ``make_trajectory`` keeps to; raises SeamarkError for an unknown kind."""
    chosen = _kind(kind)
    acceleration = max(chosen.acceleration_m_s2, 0.5 * route.speed_m_s)
    return Limits(chosen.speed_factor * route.speed_m_s, acceleration, chosen.turn_rad_s)


def make_trajectory(kind: str, route: Route, frames: int, fps: float, seed: int) -> Array:
    """Return T_world_cam (frames, 4, 4) of a smooth motion along ``route``, the same bits for the same arguments.

    The motion keeps ``limits(kind, route)``. Where ``frames`` are more than the course takes (``frames_needed``), all
    of it is slowed down; where they are fewer, its end is cut off. Raises SeamarkError for an unknown kind, a kind that
    the route does not allow, or fewer than two frames.
    """
    if frames < 2 or fps <= 0:
        raise SeamarkError(f"a trajectory needs two frames and a positive rate, not {frames} at {fps:g} per second")
    splines, slowing = _motion(kind, route, seed)
    times = np.arange(frames) / fps
    total = sum(spline.duration for spline in splines)
    times = np.minimum(times / max(slowing, float(times[-1]) / total), total)
    out, begin = np.empty((frames, 4, 4)), 0.0
    for spline in splines:
        inside = (times >= begin) if begin == 0 else (times > begin)
        out[inside] = _poses(spline(times[inside] - begin))
        begin += spline.duration
    return out


def frames_needed(kind: str, route: Route, fps: float, seed: int) -> int:
    """Return how many frames show all of a course at the highest speed that the limits allow."""
    splines, slowing = _motion(kind, route, seed)
    return int(np.ceil(slowing * sum(spline.duration for spline in splines) * fps)) + 1


def teleports(T_world_cam: Array, fps: float, fastest_m_s: float) -> list[int]:
    """Return the frames that cannot have been reached from the one before at ``fastest_m_s``."""
    steps = np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1)
    return [int(k) + 1 for k in np.flatnonzero(steps * fps > fastest_m_s)]


def _kind(kind: str) -> Kind:
    if kind not in KINDS:
        raise SeamarkError(f"there is no trajectory {kind!r}; there are {', '.join(KINDS)}")
    return KINDS[kind]


def _motion(kind: str, route: Route, seed: int) -> tuple[list[UniformSpline], float]:
    """Return splines of x, y, z, yaw, pitch, roll, one per block, and by how much time must be stretched."""
    chosen, allowed = _kind(kind), limits(kind, route)
    rng = np.random.default_rng([seed, *kind.encode()])
    driving = Limits(RESERVE * route.speed_m_s, 0.7 * allowed.acceleration_m_s2, 0.8 * allowed.turn_rad_s)
    blocks = chosen.blocks(route, driving, rng)
    phases = rng.uniform(0, 2 * np.pi, len(WAVES_M))
    splines = []
    for block in blocks:
        steps = np.linalg.norm(np.diff(block[:, :3], axis=0), axis=1)
        travelled = np.concatenate([[0], np.cumsum(steps)])
        offsets: Array = SWAY * np.sin(2 * np.pi * travelled[:, None] / WAVES_M + phases)
        pace = np.minimum(1, np.concatenate([[0], steps]) / (TICK_S * 0.5 * route.speed_m_s))
        offsets[:, 0] *= pace**2 * (3 - 2 * pace)  # not aside while it turns on the spot
        if chosen.shake is not None:
            offsets = offsets + chosen.shake.waves(rng, np.arange(len(block), dtype=np.float64) * TICK_S)
        splines.append(UniformSpline(_over_time(_moved(block, offsets)), TICK_S))
    return splines, max(1.0, *(_excess(spline, allowed) for spline in splines))


def _moved(block: Array, offsets: Array) -> Array:
    """Return (N, 6) x, y, z, yaw, pitch, roll of a block (N, 4) with its offsets (N, 5)."""
    heading = block[:, 3]
    out = np.zeros((len(block), 6))
    out[:, :4] = block
    out[:, 0] -= np.sin(heading) * offsets[:, 0]
    out[:, 1] += np.cos(heading) * offsets[:, 0]
    out[:, 2] += offsets[:, 1]
    out[:, 3:] += offsets[:, 2:]
    return out


def _over_time(samples: Array) -> Array:
    """Return samples (N + 2 reach, D) smoothed over time, with the rest before the start and after the end."""
    sigma = SMOOTHING_S / TICK_S
    reach = int(4 * sigma)
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma).ravel()
    padded = np.pad(samples, ((2 * reach, 2 * reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)


def _poses(samples: Array) -> Array:
    """Return T_world_cam (N, 4, 4) of x, y, z, yaw, pitch (nose down), roll."""
    out = np.tile(np.eye(4), (len(samples), 1, 1))
    cosine, sine = np.cos(samples[:, 3:]).T, np.sin(samples[:, 3:]).T
    zero, one = np.zeros(len(samples)), np.ones(len(samples))
    yaw = np.array([[cosine[0], -sine[0], zero], [sine[0], cosine[0], zero], [zero, zero, one]])
    pitch = np.array([[cosine[1], zero, sine[1]], [zero, one, zero], [-sine[1], zero, cosine[1]]])
    roll = np.array([[one, zero, zero], [zero, cosine[2], -sine[2]], [zero, sine[2], cosine[2]]])
    turned = yaw.transpose(2, 0, 1) @ pitch.transpose(2, 0, 1) @ roll.transpose(2, 0, 1)
    out[:, :3, :3] = turned @ se3.T_WORLD_LEVEL_CAM[:3, :3]
    out[:, :3, 3] = samples[:, :3]
    return out


def _excess(spline: UniformSpline, allowed: Limits) -> float:
    """Return by what factor time must be stretched for the motion to keep the limits."""
    speed, acceleration, rate = measured(_poses(spline(np.arange(0, spline.duration, CHECK_S))), 1 / CHECK_S)
    return max(speed / allowed.speed_m_s, np.sqrt(acceleration / allowed.acceleration_m_s2), rate / allowed.turn_rad_s)


def measured(T_world_cam: NDArray[np.float64], fps: float) -> tuple[float, float, float]:
    """Return the greatest speed (m/s), acceleration (m/s^2) and turning rate (rad/s), by finite differences."""
    velocity = np.diff(T_world_cam[:, :3, 3], axis=0) * fps
    acceleration = np.diff(velocity, axis=0) * fps
    steps = se3.rotation_angle(np.swapaxes(T_world_cam[:-1, :3, :3], 1, 2) @ T_world_cam[1:, :3, :3])
    return (
        float(np.linalg.norm(velocity, axis=1).max(initial=0)),
        float(np.linalg.norm(acceleration, axis=1).max(initial=0)),
        float(steps.max(initial=0)) * fps,
    )
