"""Surfaces that give a front end little to hold on to: painted walls, linoleum, ceilings, and what wear does to others.

Same manners as :mod:`seamark.datasets_synth.textures`: a random generator, a size in pixels and pixels per metre in,
BGR uint8 (height, width, 3) out. Contrast is low at all scales, as on real plaster and floors; what can be found are
things: sockets, ducts, seams, scuffs.
"""

import cv2
import numpy as np

from seamark.datasets_synth.textures import Field, Image, noise, random_colour, tint, to_image


def paint(rng: np.random.Generator) -> Field:
    """Return a colour (3,) that rooms are painted in."""
    return random_colour(rng, 150, 215, 0.35)


def painted(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float, colour: Field) -> Image:
    """Return a painted wall: clouds of dirt, the grain of the roller, skirting, scuffs, perhaps a dado and a duct."""
    scale = pixels_per_metre
    relief = 0.035 * noise(rng, height, width, 1.4 * scale, 4) + 0.012 * noise(rng, height, width, 4.0, 2)
    low = np.clip(1 - (height - np.arange(height)) / (0.9 * scale), 0, 1).astype(np.float32)[:, None]
    dirt = 0.05 * low * (1 + noise(rng, height, width, 0.5 * scale, 3))
    ground = tint(colour, relief - dirt)
    if rng.random() < 0.35:  # a lower part in another paint
        ground[max(0, height - int(1.15 * scale)) :] *= random_colour(rng, 150, 215, 0.5) / 190
    canvas = to_image(ground)
    skirting = max(1, int(0.09 * scale))
    canvas[-skirting:] = (0.55 * canvas[-skirting:]).astype(np.uint8)
    metres = width / scale
    for _ in range(int(rng.poisson(1.2 * metres))):
        x, y = int(rng.integers(width)), int(height - rng.uniform(0.15, 1.1) * scale)
        end = (x + int(rng.normal(0, 0.12 * scale)), y + int(rng.normal(0, 0.03 * scale)))
        cv2.line(canvas, (x, y), end, (rng.uniform(0.7, 0.9) * colour).tolist(), int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(int(rng.poisson(0.4 * metres))):
        _socket(rng, canvas, scale)
    if rng.random() < 0.3:
        row = int(rng.uniform(0.1, 0.3) * scale)
        cv2.rectangle(canvas, (0, row), (width, row + int(0.05 * scale)), (0.9 * colour).tolist(), -1)
        cv2.line(canvas, (0, row + int(0.05 * scale)), (width, row + int(0.05 * scale)), (0.6 * colour).tolist(), 1)
    return canvas


def _socket(rng: np.random.Generator, canvas: Image, scale: float) -> None:
    """Draw a socket low down or a switch at the height of a hand, in place."""
    side = max(3, int(0.08 * scale))
    row = canvas.shape[0] - int((0.3 if rng.random() < 0.6 else 1.1) * scale) - side
    column = int(rng.integers(max(1, canvas.shape[1] - 2 * side)))
    for number in range(int(rng.integers(1, 3))):
        x = column + number * side
        cv2.rectangle(canvas, (x, row), (x + side, row + side), (225, 228, 228), -1)
        cv2.rectangle(canvas, (x, row), (x + side, row + side), (120, 122, 122), 1)
        cv2.circle(canvas, (x + side // 2, row + side // 2), max(1, side // 3), (170, 172, 172), -1, cv2.LINE_AA)


def linoleum(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return a floor covering in sheets: faint flecks, seams 2 m apart, lanes worn paler, stains and scratches."""
    scale = pixels_per_metre
    colour = random_colour(rng, 85, 160, 0.4)
    flecks = 0.05 * noise(rng, height, width, max(2.0, 0.025 * scale), 2)
    worn = 0.06 * noise(rng, height, width, 1.6 * scale, 3)
    canvas = to_image(tint(colour, flecks + worn))
    for x in np.arange(rng.uniform(0.3, 2.0), width / scale, 2.0):
        cv2.line(canvas, (int(x * scale), 0), (int(x * scale), height), (0.75 * colour).tolist(), 1, cv2.LINE_AA)
    area = height * width / scale**2
    for _ in range(int(rng.poisson(0.5 * area))):
        place = (rng.uniform(0, 1, 2) * (width, height)).astype(int)
        if rng.random() < 0.5:
            axes = (rng.uniform(0.01, 0.07, 2) * scale + 1).astype(int).tolist()
            shade = (rng.uniform(0.72, 1.12) * colour).clip(0, 255).tolist()
            cv2.ellipse(canvas, place.tolist(), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
        else:
            end = place + rng.normal(0, 0.15 * scale, 2).astype(int)
            cv2.line(canvas, place.tolist(), end.tolist(), (0.7 * colour).tolist(), 1, cv2.LINE_AA)
    return canvas


def ceiling(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return a ceiling: painted, or hung with plates that are all alike but for water stains."""
    scale = pixels_per_metre
    colour = random_colour(rng, 185, 225, 0.12)
    relief = 0.02 * noise(rng, height, width, 1.5 * scale, 3) + 0.01 * noise(rng, height, width, 4.0, 2)
    canvas = to_image(tint(colour, relief))
    if rng.random() < 0.5:
        pitch = 0.625 * scale
        for x in np.arange(pitch / 2, width, pitch).astype(int).tolist():
            cv2.line(canvas, (x, 0), (x, height), (0.82 * colour).tolist(), max(1, int(0.015 * scale)))
        for y in np.arange(pitch / 2, height, pitch).astype(int).tolist():
            cv2.line(canvas, (0, y), (width, y), (0.82 * colour).tolist(), max(1, int(0.015 * scale)))
    area = height * width / scale**2
    stains = np.zeros((height, width), np.float32)
    for _ in range(int(rng.poisson(0.12 * area))):
        place = (rng.uniform(0, 1, 2) * (width, height)).astype(int)
        axes = (rng.uniform(0.06, 0.25, 2) * scale).astype(int).tolist()
        cv2.ellipse(stains, place.tolist(), axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(0.03, 0.1)), -1)
    stains = cv2.GaussianBlur(stains, (0, 0), 0.03 * scale)
    return to_image(canvas * (1 - stains[..., None] * np.array([1.6, 1.0, 0.7], np.float32)))


def worn(rng: np.random.Generator, image: Image, pixels_per_metre: float, contrast: tuple[float, float]) -> Image:
    """Return the picture faded and dirty: colours muted, its contrast times one from ``contrast``, large stains."""
    height, width = image.shape[:2]
    mean = image.reshape(-1, 3).mean(axis=0)
    grey = image.mean(axis=2, keepdims=True)
    muted = grey + 0.6 * (image - grey)
    faded = mean + rng.uniform(*contrast) * (muted - mean)
    return to_image(faded * (1 + 0.06 * noise(rng, height, width, 1.3 * pixels_per_metre, 3))[..., None])


def muted(image: Image, saturation: float) -> Image:
    """Return the picture with its colours drawn towards grey."""
    grey = image.mean(axis=2, keepdims=True)
    return np.ascontiguousarray(to_image(grey + saturation * (image - grey)))


def slabs(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return paving slabs of concrete: nearly one shade, dirty joints, spots of chewing gum, repaired pieces."""
    scale = pixels_per_metre
    colour = random_colour(rng, 120, 165, 0.15)
    side = 0.5 * scale
    y, x = np.arange(height) / side, np.arange(width) / side
    shades = rng.uniform(-0.06, 0.06, (int(y[-1]) + 1, int(x[-1]) + 1))
    relief = np.ascontiguousarray(shades[y.astype(int)][:, x.astype(int)], np.float32)
    relief += 0.035 * noise(rng, height, width, 3.0, 2) + 0.07 * noise(rng, height, width, 1.5 * scale, 3)
    canvas = to_image(tint(colour, relief))
    joint = max(1, int(0.012 * scale))
    canvas[(y % 1) * side < joint] = (0.65 * colour).astype(np.uint8)
    canvas[:, (x % 1) * side < joint] = (0.65 * colour).astype(np.uint8)
    for _ in range(int(2.5 * height * width / scale**2)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        radius = max(1, int(rng.uniform(0.008, 0.025) * scale))
        cv2.circle(canvas, centre, radius, (rng.uniform(0.6, 0.9) * colour).tolist(), -1, cv2.LINE_AA)
    return canvas
