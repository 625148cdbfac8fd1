"""The lap through the world loop: along a rounded path, slow in turns, with the sway of a walking robot."""

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.trajectory import look

STEP_M = 0.01  # of the path before it is resampled


def rounded(corners: NDArray[np.float64], rounding_m: float) -> NDArray[np.float64]:
    """Return the closed polyline (N, 2), whose last corner is its first, smoothed by a Gaussian of ``rounding_m``."""
    distances = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.arange(0, distances[-1], STEP_M)
    path = np.stack([np.interp(s, distances, corners[:, axis]) for axis in range(2)], axis=1)
    reach = int(5 * rounding_m / STEP_M)
    padded = np.concatenate([path[-reach:], path, path[:reach]])
    kernel = cv2.getGaussianKernel(2 * reach + 1, rounding_m / STEP_M).ravel()
    return np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in range(2)], axis=1)


def walk(
    path: NDArray[np.float64], n_frames: int, seed: int, eye_height_m: float, turn_cost_m: float
) -> NDArray[np.float64]:
    """Return T_world_cam (N, 4, 4) along ``path`` (N, 2): one radian of turning takes as long as ``turn_cost_m``."""
    rng = np.random.default_rng([seed, 0x9A7])
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    effort = np.concatenate([[0], np.cumsum(lengths[1:] + turn_cost_m * np.abs(np.diff(headings)))])
    at = np.interp(np.linspace(0, effort[-1], n_frames), effort, np.arange(len(effort), dtype=np.float64))
    place = np.stack([np.interp(at, np.arange(len(path)), path[:, axis]) for axis in range(2)], axis=1)
    heading = np.interp(at, np.arange(len(headings)), headings)
    travelled = np.interp(at, np.arange(len(path)), np.concatenate([[0], np.cumsum(lengths)]))
    phases = rng.uniform(0, 2 * np.pi, 6)
    waves = np.sin(2 * np.pi * travelled[:, None] / np.array([7.3, 5.9, 4.7, 6.7, 8.9, 3.7]) + phases)
    amplitudes = np.array([0.09, 0.02, np.deg2rad(2.5), np.deg2rad(1.5), np.deg2rad(1.0), 0.01])
    side, lift, yaw, pitch, roll, bob = (waves * amplitudes).T
    aside = np.stack([-np.sin(heading), np.cos(heading)], axis=1) * side[:, None]
    position = np.column_stack([place + aside, eye_height_m + lift + bob])
    return np.stack([look(*sample) for sample in zip(position, heading + yaw, pitch, roll, strict=True)])
