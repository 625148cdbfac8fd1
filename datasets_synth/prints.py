"""Things that people hang up and put down: posters with pseudo text and pictures, stickers, shelves, cartons.

Same manners as :mod:`seamark.datasets_synth.textures`: a random generator and a size in, BGR uint8 (height, width, 3)
out.
"""

import cv2
import numpy as np

from seamark.datasets_synth.textures import Field, Image, noise, random_colour, tint, to_image

LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVWXZabcdefghiklmnoprstuvz0123456789"))
FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)


def gradient(rng: np.random.Generator, height: int, width: int) -> Field:
    """Return a linear blend (H, W, 3) float32 of two random colours in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    along = np.cos(angle) * x / width + np.sin(angle) * y / height
    along = (along - along.min()) / max(1e-6, float(np.ptp(along)))
    first, second = random_colour(rng, 20, 240), random_colour(rng, 20, 240)
    blend: Field = (first + along[..., None] * (second - first)).astype(np.float32)
    return blend


def draw_text(rng: np.random.Generator, canvas: Image, box: tuple[int, int, int, int], line_px: float) -> None:
    """Write random words into ``box`` (x, y, width, height) of the canvas, in place, lines ``line_px`` apart."""
    x, y, width, height = box
    font, scale = int(rng.choice(FONTS)), line_px / 36
    colour = tuple(random_colour(rng, 0, 255).tolist())
    thickness = max(1, int(line_px / 14))
    for baseline in np.arange(y + line_px, y + height, 1.15 * line_px):
        words = ["".join(rng.choice(LETTERS, int(rng.integers(2, 9)))) for _ in range(int(rng.integers(1, 6)))]
        visible = max(2, int(width / (0.5 * line_px)))
        cv2.putText(canvas, " ".join(words)[:visible], (x, int(baseline)), font, scale, colour, thickness, cv2.LINE_AA)


def draw_shape(rng: np.random.Generator, canvas: Image, centre: tuple[int, int], radius: float) -> None:
    """Draw one random filled shape (ellipse, polygon, ring, star) with a textured look onto the canvas, in place."""
    colour = tuple(random_colour(rng, 10, 245, 1.3).tolist())
    kind = int(rng.integers(4))
    whole = max(2, int(radius))
    if kind == 0:
        axes = (whole, max(2, int(radius * rng.uniform(0.3, 1))))
        cv2.ellipse(canvas, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
    elif kind == 1:
        cv2.circle(canvas, centre, whole, colour, max(1, whole // 4), cv2.LINE_AA)
    else:
        count = int(rng.integers(3, 9))
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        radii = radius * (rng.uniform(0.6, 1.0, count) if kind == 2 else np.where(np.arange(count) % 2, 0.4, 1.0))
        corners = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radii[:, None] + centre
        cv2.fillPoly(canvas, [corners.astype(np.int32)], colour, cv2.LINE_AA)


def picture(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return something like a photograph: a sky, ridges of noise one behind the other, and a few objects."""
    canvas = gradient(rng, height, width) * (1 + 0.1 * noise(rng, height, width, max(4, width / 4), 3))[..., None]
    rows = np.arange(height, dtype=np.float32)[:, None]
    for horizon in np.sort(rng.uniform(0.25, 0.9, int(rng.integers(2, 5)))):
        ridge = height * (horizon + 0.1 * noise(rng, 1, width, width / 3, 5))
        ground = tint(random_colour(rng, 20, 200), 0.25 * noise(rng, height, width, max(3, width / 12), 5))
        canvas = np.where((rows > ridge)[..., None], ground, canvas)
    image = to_image(canvas)
    for _ in range(int(rng.integers(2, 8))):
        centre = (int(rng.integers(width)), int(rng.integers(height // 2, height)))
        draw_shape(rng, image, centre, float(rng.uniform(0.04, 0.15)) * width)
    return image


def poster(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a poster with a border, a picture or shapes, a title and small print; no two are alike."""
    canvas = to_image(gradient(rng, height, width))
    if rng.random() < 0.5:
        top, bottom = int(height * rng.uniform(0.05, 0.3)), int(height * rng.uniform(0.6, 0.95))
        left, right = int(width * rng.uniform(0.03, 0.15)), int(width * rng.uniform(0.8, 0.97))
        canvas[top:bottom, left:right] = picture(rng, bottom - top, right - left)
    else:
        for _ in range(int(rng.integers(8, 30))):
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            draw_shape(rng, canvas, centre, float(rng.uniform(0.03, 0.25)) * min(width, height))
    title_px = height * rng.uniform(0.08, 0.16)
    start = int(height * rng.uniform(0.0, 0.8))
    draw_text(rng, canvas, (int(0.05 * width), start, int(0.9 * width), int(1.3 * title_px)), title_px)
    small_px = max(7.0, height * rng.uniform(0.025, 0.05))
    left, top = int(width * rng.uniform(0.03, 0.4)), int(height * rng.uniform(0.3, 0.7))
    draw_text(rng, canvas, (left, top, int(0.55 * width), int(height * rng.uniform(0.1, 0.3))), small_px)
    grain = 1 + 0.03 * noise(rng, height, width, 3.0, 2)
    canvas = to_image(canvas * grain[..., None])
    border = max(1, int(0.02 * min(height, width)))
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), random_colour(rng, 0, 255).tolist(), border)
    return canvas


def shelf(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a book shelf seen from the front: boards and rows of spines with marks."""
    canvas = np.full((height, width, 3), 35, np.uint8)
    boards = max(2, round(height / max(24.0, 0.35 * width)))
    pitch, board = height / boards, max(2, int(0.06 * height / boards))
    wood_colour = random_colour(rng, 60, 160, 0.4).tolist()
    for level in range(boards):
        bottom = int((level + 1) * pitch) - board
        cv2.rectangle(canvas, (0, bottom), (width, bottom + board), wood_colour, -1)
        x = 2
        while x < width - 3:
            spine, tall = max(3, int(pitch * rng.uniform(0.06, 0.22))), int(pitch * rng.uniform(0.5, 0.88))
            if rng.random() < 0.9:
                colour = random_colour(rng, 20, 230, 1.2)
                cv2.rectangle(canvas, (x, bottom - tall), (x + spine - 1, bottom - 1), colour.tolist(), -1)
                for mark in rng.uniform(0.1, 0.9, int(rng.integers(1, 5))):
                    mark_y = int(bottom - mark * tall)
                    tone = ((colour + 120) % 255).tolist()
                    cv2.rectangle(canvas, (x + 1, mark_y), (x + spine - 2, mark_y + max(1, tall // 14)), tone, -1)
            x += spine
    return to_image(canvas * (1 + 0.05 * noise(rng, height, width, 4.0, 2))[..., None])


def carton(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the side of a crate or carton: stained board with labels, tape, print and shapes."""
    colour = random_colour(rng, 70, 190, 0.7)
    canvas = to_image(tint(colour, 0.1 * noise(rng, height, width, max(4, width / 4), 4)))
    cv2.rectangle(
        canvas, (0, int(0.45 * height)), (width, int(0.55 * height)), (1.2 * colour).clip(0, 255).tolist(), -1
    )
    for _ in range(int(rng.integers(3, 9))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        draw_shape(rng, canvas, centre, float(rng.uniform(0.05, 0.18)) * min(width, height))
    for _ in range(int(rng.integers(1, 4))):
        line = max(7.0, height * rng.uniform(0.06, 0.14))
        corner = (int(width * rng.uniform(0, 0.5)), int(height * rng.uniform(0, 0.7)))
        draw_text(rng, canvas, (*corner, int(0.5 * width), int(2.5 * line)), line)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (0.5 * colour).tolist(), max(1, width // 60))
    return canvas


def add_stickers(rng: np.random.Generator, canvas: Image, pixels_per_metre: float, per_square_metre: float) -> Image:
    """Return the canvas with small coloured shapes, marks and notes strewn over it."""
    canvas = canvas.copy()
    height, width = canvas.shape[:2]
    for _ in range(int(per_square_metre * height * width / pixels_per_metre**2)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        size = pixels_per_metre * float(rng.uniform(0.015, 0.07))
        if rng.random() < 0.75:
            draw_shape(rng, canvas, centre, size)
        else:
            box = (*centre, int(6 * size), int(2.5 * size))
            draw_text(rng, canvas, box, max(7.0, 1.2 * size))
    return canvas
