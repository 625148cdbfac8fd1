"""Endless varied pictures for training visual words, so that nothing is ever trained on photographs it is tested on.

Seven kinds of scenes (rooms, streets, landscapes, structures, ragged layers, thickets, and the dead-leaves model of
natural images: A. Lee, D. Mumford, J. Huang, "Occlusion models for natural images", IJCV 2001) go through the model of
a cheap camera: light, shadows, blur, noise, JPEG.
"""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import outdoors, prints, scenery, textures
from seamark.datasets_synth.textures import Image, noise, random_colour, to_image

Patch = Callable[[np.random.Generator, int, int], Image]

INDOOR: tuple[Patch, ...] = (prints.poster, prints.shelf, prints.carton, prints.picture)
OUTDOOR: tuple[Patch, ...] = (outdoors.facade, outdoors.foliage, outdoors.grass, outdoors.hills)


def material(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return one of the surfaces of :mod:`seamark.datasets_synth.textures` at a random scale."""
    choices = tuple(dict.fromkeys((*textures.WALLS, *textures.FLOORS)))
    return choices[int(rng.integers(len(choices)))](rng, height, width, float(np.exp(rng.uniform(3.9, 5.8))))


def _any_patch(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return any surface, print or outdoor picture."""
    choices = (material, material, *INDOOR, *OUTDOOR)
    return choices[int(rng.integers(len(choices)))](rng, height, width)


def _paste(canvas: Image, patch: Image, corners: NDArray[np.floating]) -> Image:
    """Return the canvas with the patch warped onto the quadrilateral ``corners`` (4, 2): TL, TR, BR, BL."""
    height, width = canvas.shape[:2]
    rows, columns = patch.shape[:2]
    outline = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32)
    H = cv2.getPerspectiveTransform(outline, corners.astype(np.float32))
    warped = cv2.warpPerspective(patch, H, (width, height), flags=cv2.INTER_AREA)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 255)
    pasted: Image = np.where(mask[..., None] > 0, warped, canvas)
    return pasted


def _tunnel(
    rng: np.random.Generator, size: tuple[int, int], sides: Patch, below: Patch, above: Patch, end: Patch
) -> Image:
    """Return the view along a space with two sides, something below and above, and an end."""
    width, height = size
    x = np.sort(width * rng.uniform((-0.05, 0.55), (0.45, 1.05)))
    y = np.sort(height * rng.uniform((0.1, 0.52), (0.45, 0.8)))
    far = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    eye = far.mean(axis=0)
    reach = np.max([eye / (eye - far[0]), (np.array(size) - eye) / (far[2] - eye)]) + rng.uniform(0.05, 2.0)
    near = eye + (far - eye) * reach  # covers the whole picture
    canvas = np.zeros((height, width, 3), np.uint8)
    order = ((3, 2, below), (1, 0, above), (0, 3, sides), (2, 1, sides))
    for a, b, maker in order:
        # TL, TR, BR, BL of each flank as seen from inside
        corners = {0: (near[0], far[0], far[3], near[3]), 2: (far[1], near[1], near[2], far[2])}.get(
            a, (far[a], far[b], near[b], near[a])
        )
        canvas = _paste(canvas, maker(rng, int(rng.integers(240, 420)), int(rng.integers(400, 900))), np.stack(corners))
    return _paste(canvas, end(rng, 300, int(max(80, 300 * (x[1] - x[0]) / max(1.0, y[1] - y[0])))), far)


def _scatter(rng: np.random.Generator, canvas: Image, makers: tuple[Patch, ...], count: int) -> Image:
    """Return the canvas with ``count`` pictures in random perspective on top."""
    height, width = canvas.shape[:2]
    for _ in range(count):
        centre = rng.uniform(0.05, 0.95, 2) * (width, height)
        extent = rng.uniform(0.06, 0.28, 2) * (width, width)
        box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * extent / 2
        lean = 1 + rng.uniform(-0.25, 0.25) * np.array([-1, 1, 1, -1])
        corners = centre + box * np.stack([np.ones(4), lean], axis=1) + rng.normal(0, 3, (4, 2))
        maker = makers[int(rng.integers(len(makers)))]
        canvas = _paste(canvas, maker(rng, max(40, int(1.3 * extent[1])), max(40, int(1.3 * extent[0]))), corners)
    return canvas


def room(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return a room or corridor with things on the walls and on the floor."""
    canvas = _tunnel(rng, size, material, material, material, material)
    canvas = prints.add_stickers(rng, canvas, 150.0, float(rng.uniform(0, 4)))
    return _scatter(rng, canvas, INDOOR, int(rng.integers(3, 10)))


def street(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return a street: facades, road, sky, trees, poles, things that stand around."""
    canvas = _tunnel(rng, size, outdoors.facade, material, prints.picture, outdoors.hills)
    width, height = size
    for _ in range(int(rng.integers(0, 5))):
        foot = (rng.uniform(0, width), rng.uniform(0.6, 0.95) * height)
        tall = rng.uniform(0.2, 0.6) * height
        outdoors.draw_branch(rng, canvas, foot, np.pi / 2, 0.4 * tall)
        outdoors.draw_leaves(rng, canvas, (foot[0], foot[1] - tall), 0.5 * tall, int(rng.integers(80, 300)))
    for x in rng.uniform(0, width, int(rng.integers(0, 4))).astype(int).tolist():
        top = int(rng.uniform(0, 0.5) * height)
        tone = random_colour(rng, 20, 200, 0.3).tolist()
        cv2.line(canvas, (x, top), (x, int(0.9 * height)), tone, int(rng.integers(2, 9)), cv2.LINE_AA)
    return _scatter(rng, canvas, (prints.carton, prints.poster), int(rng.integers(0, 5)))


def landscape(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return hills, a meadow, a hedge, perhaps a building."""
    width, height = size
    canvas = outdoors.hills(rng, height, width)
    horizon = int(height * rng.uniform(0.5, 0.8))
    canvas[horizon:] = outdoors.grass(rng, height - horizon, width)
    for _ in range(int(rng.integers(0, 3))):
        canvas = _scatter(rng, canvas, (outdoors.facade,), 1)
    for _ in range(int(rng.integers(2, 12))):
        centre = (rng.uniform(0, width), rng.uniform(0.3, 1.0) * height)
        outdoors.draw_leaves(rng, canvas, centre, rng.uniform(0.05, 0.25) * width, int(rng.integers(40, 200)))
    return canvas


def dead_leaves(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return textured shapes of all sizes (radii r with density r^-3) that cover one another."""
    width, height = size
    pool = [_any_patch(rng, height, width) for _ in range(int(rng.integers(3, 6)))]
    canvas = pool[0].copy()
    smallest, largest = float(rng.uniform(5, 14)), 0.4 * width
    for share in rng.uniform(0, 1, int(rng.integers(100, 350))):
        radius = smallest / np.sqrt(1 - share * (1 - (smallest / largest) ** 2))
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        left, right = max(0, int(x - radius)), min(width, int(x + radius) + 1)
        top, bottom = max(0, int(y - radius)), min(height, int(y + radius) + 1)
        mask = np.zeros((bottom - top, right - left, 1), np.uint8)
        prints.draw_shape(rng, mask, (int(x - left), int(y - top)), radius)
        alpha = (mask > 0).astype(np.float32) * min(1.0, rng.uniform(0.6, 1.6))
        source = pool[int(rng.integers(len(pool)))][top:bottom, left:right]
        fill = source * rng.uniform(0.5, 1.3) if rng.random() < 0.7 else random_colour(rng, 10, 245, 0.7)
        window = canvas[top:bottom, left:right]
        canvas[top:bottom, left:right] = to_image(window + alpha * (fill - window))
    return canvas


def structures(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return what people build, as edges of all sizes: bars, rails, steps, panes and struts in random perspective."""
    width, height = size
    canvas = _tunnel(rng, size, scenery.bark if rng.random() < 0.5 else material, material, material, _any_patch)
    for _ in range(int(rng.integers(6, 25))):
        patch = _lattice(rng, 160)
        centre = rng.uniform(0, 1, 2) * (width, height)
        extent = np.exp(rng.normal(-1.6, 0.6, 2)) * width
        lean = 1 + rng.uniform(-0.5, 0.5) * np.array([-1, 1, 1, -1])
        box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * extent / 2
        canvas = _paste(canvas, patch, centre + box * np.stack([np.ones(4), lean], axis=1))
    return canvas


def _lattice(rng: np.random.Generator, side: int) -> Image:
    """Return a square of bars across or upright, of panes, or of struts."""
    patch = np.full((side, side, 3), random_colour(rng, 10, 245, 0.4), np.float32)
    count, rows = int(rng.integers(1, 14)), int(rng.integers(1, 7))
    kind = int(rng.integers(4))

    def fill(left: float, top: float, right: float, bottom: float) -> None:
        corners = [(int(side * x), int(side * y)) for x, y in ((left, top), (right, bottom))]
        cv2.rectangle(patch, corners[0], corners[1], random_colour(rng, 10, 245, 0.3).tolist(), -1)

    for k in range(count):
        if kind == 0:
            fill(0, k / count, 1, (k + rng.uniform(0.2, 0.8)) / count)
        elif kind == 1:
            fill(k / count, 0, (k + rng.uniform(0.1, 0.8)) / count, 1)
        elif kind == 2:
            for row in range(rows):
                fill((k + 0.15) / count, (row + 0.15) / rows, (k + 0.8) / count, (row + 0.85) / rows)
        else:
            ends = rng.integers(0, side, (2, 2)).tolist()
            cv2.line(patch, ends[0], ends[1], random_colour(rng, 10, 245, 0.3).tolist(), int(rng.integers(1, 12)))
    return to_image(patch * (1 + rng.uniform(0.02, 0.12) * noise(rng, side, side, side / 4))[..., None])


def photograph(rng: np.random.Generator, scene: Image) -> Image:
    """Return the scene as a cheap camera sees it: muted colours, light and shade, blur, noise, JPEG."""
    height, width = scene.shape[:2]
    values = scene.astype(np.float32)
    grey = values.mean(axis=2, keepdims=True)
    values = grey + rng.uniform(0.1, 0.9) * (values - grey)
    light = 0.35 * noise(rng, height, width, 0.7 * width, 2) * rng.uniform(0, 1)
    if rng.random() < 0.4:
        edge = noise(rng, height, width, 0.5 * width, 2)
        light -= rng.uniform(0.1, 0.5) / (1 + np.exp(np.clip(-edge * rng.uniform(5, 40), -30, 30)))
    values = 255 * (np.clip(values * (1 + light)[..., None], 0, 255) / 255) ** rng.uniform(0.65, 1.5)
    values = 128 + rng.uniform(0.45, 1.0) * (values - 128) + rng.uniform(-25, 25)
    sigma = float(np.abs(rng.normal(0.5, 0.5)))
    if sigma > 0.2:
        values = cv2.GaussianBlur(values, (0, 0), sigma)
    values += rng.uniform(0.5, 5) * rng.standard_normal(values.shape, np.float32)
    image = to_image(values)
    if rng.random() < 0.5:
        _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(55, 96))])
        decoded: Image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
        return decoded
    return image


def training_images(seed: int, n: int, size: tuple[int, int] = (640, 480)) -> Iterator[Image]:
    """Yield ``n`` generated BGR uint8 images of ``size`` (width, height); image i depends on ``seed`` and i only."""
    kinds = (room, street, landscape, dead_leaves, structures, scenery.layers, scenery.thicket)
    for index in range(n):
        rng = np.random.default_rng([seed, index, 0x1A6E])
        yield photograph(rng, kinds[index % len(kinds)](rng, size))
