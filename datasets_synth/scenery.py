"""Scenes without anything straight: fields with the spectrum of natural images, thickets of stems, blades and leaves.

Same manners as :mod:`seamark.datasets_synth.textures`. Amplitudes of natural images fall about as 1 / frequency (Field,
"Relations between the statistics of natural images and the response properties of cortical cells", JOSA A 1987).
"""

import cv2
import numpy as np

from seamark.datasets_synth import outdoors, textures
from seamark.datasets_synth.textures import Field, Image, noise, to_image

LARGEST_PERIODS = 1.5  # frequencies below so many periods per picture are not raised further


def spectrum(rng: np.random.Generator, height: int, width: int, slope: float, stretch: float) -> Field:
    """Return a random field (height, width) float32, mean 0, deviation 1, with amplitudes as 1 / frequency^slope.

    It is drawn out by ``stretch`` in a random direction.
    """
    angle = rng.uniform(0, np.pi)
    y, x = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    along, across = np.cos(angle) * x + np.sin(angle) * y, stretch * (np.cos(angle) * y - np.sin(angle) * x)
    frequency = np.hypot(along, across) + LARGEST_PERIODS / max(height, width)
    shape = (height, width // 2 + 1)
    waves = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / frequency**slope
    field = np.fft.irfft2(waves, (height, width)).astype(np.float32)
    normal: Field = (field - field.mean()) / (field.std() + 1e-6)
    return normal


def bark(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a rough surface: clouds, or ridges as of bark, cracks and crumpled cloth."""
    relief: Field = spectrum(rng, height, width, rng.uniform(0.9, 1.7), float(np.exp(rng.normal(0, 0.7))))
    if rng.random() < 0.5:
        relief = np.abs(relief) - np.float32(0.8)
    if rng.random() < 0.3:
        relief = (np.sign(relief) * np.sqrt(np.abs(relief))).astype(np.float32)
    colour = textures.random_colour(rng, 30, 220, 0.6)
    return to_image(colour * (1 + rng.uniform(0.1, 0.6) * relief)[..., None])


def layers(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return rough surfaces that cover one another in ragged outlines, each where a field is above a level."""
    width, height = size
    canvas = bark(rng, height, width)
    for _ in range(int(rng.integers(3, 12))):
        outline = spectrum(rng, height, width, rng.uniform(1.3, 2.2), float(np.exp(rng.normal(0, 0.5))))
        steepness = rng.uniform(3, 40)
        cover = 1 / (1 + np.exp(-np.clip((outline - rng.uniform(0.2, 1.4)) * steepness, -30, 30)))
        canvas = to_image(canvas + cover[..., None] * (bark(rng, height, width).astype(np.float32) - canvas))
    return canvas


def thicket(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return stems, blades and leaves of all sizes before a dark depth."""
    width, height = size
    canvas = to_image(bark(rng, height, width) * rng.uniform(0.3, 0.8))
    for _ in range(int(rng.integers(2, 5))):
        for _ in range(int(rng.integers(2, 9))):
            kind = rng.random()
            if kind < 0.4:
                foot = (rng.uniform(0, width), height * rng.uniform(0.6, 1.1))
                outdoors.draw_branch(rng, canvas, foot, rng.uniform(1.0, 2.1), rng.uniform(0.1, 0.3) * height)
            elif kind < 0.7:
                _draw_blades(rng, canvas)
            else:
                centre = (rng.uniform(0, width), rng.uniform(0, height))
                outdoors.draw_leaves(rng, canvas, centre, rng.uniform(0.05, 0.3) * width, int(rng.integers(40, 300)))
        shade = np.clip(1 + 0.4 * noise(rng, height, width, width / 3, 3), 0.3, 1.5)
        canvas = to_image(canvas * shade[..., None])
    return canvas


def _draw_blades(rng: np.random.Generator, canvas: Image) -> None:
    """Draw a tuft of bent blades from one root, in place."""
    height, width = canvas.shape[:2]
    root = np.array([rng.uniform(0, width), rng.uniform(0.4, 1.1) * height])
    colour = np.array(outdoors.leaf_colour(rng))
    along = np.linspace(0, 1, 8)
    for _ in range(int(rng.integers(6, 40))):
        length = rng.uniform(0.05, 0.25) * height
        angle = rng.normal(-np.pi / 2, 0.7) + rng.normal(0, 0.5) * along
        path = root + length * along[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        shade = (colour * rng.uniform(0.6, 1.4)).tolist()
        cv2.polylines(canvas, [path.astype(np.int32)], False, shade, int(rng.integers(1, 6)), cv2.LINE_AA)
