"""What belongs to buildings: radiators, boards, doors, and the fronts of houses with windows that repeat.

Same manners as :mod:`seamark.datasets_synth.textures`: a random generator and a size in, BGR uint8 (height, width, 3)
out.
"""

import cv2
import numpy as np

from seamark.datasets_synth import plain, prints, textures
from seamark.datasets_synth.textures import Image, noise, random_colour, tint, to_image

WINDOW_KINDS = 3  # per house: clear, curtains, blind
PLAIN_FRONTS = 0.55


def radiator(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a radiator: fins that are all alike, a rail above and below."""
    colour = random_colour(rng, 195, 225, 0.1)
    pitch = max(5.0, height / 11)
    fins = 0.10 * np.cos(2 * np.pi * np.arange(width, dtype=np.float32) / pitch)
    canvas = to_image(tint(colour, fins[None] + 0.02 * noise(rng, height, width, height / 2, 3)))
    for row in (0, height - max(2, height // 9)):
        canvas[row : row + max(2, height // 9)] = (0.88 * colour).astype(np.uint8)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (0.5 * colour).tolist(), 1)
    return canvas


def notice_board(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a board with sheets of paper pinned to it, askew and over one another, mostly print on white."""
    canvas = to_image(tint(np.array([95.0, 130.0, 160.0]), 0.08 * noise(rng, height, width, 4.0, 2)))
    for _ in range(int(rng.integers(4, 11))):
        tall, wide = int(height * rng.uniform(0.25, 0.5)), int(height * rng.uniform(0.2, 0.4))
        x, y = int(rng.uniform(0.02, 0.9) * (width - wide)), int(rng.uniform(0.03, 0.9) * (height - tall))
        sheet = np.full((tall, wide, 3), int(rng.integers(195, 245)), np.uint8)
        prints.draw_text(rng, sheet, (3, 0, wide - 6, int(0.3 * tall)), max(8.0, 0.13 * tall))
        prints.draw_text(rng, sheet, (3, int(0.35 * tall), wide - 6, int(0.6 * tall)), max(6.0, 0.07 * tall))
        cv2.rectangle(sheet, (0, 0), (wide - 1, tall - 1), (150, 150, 150), 1)
        canvas[y : y + tall, x : x + wide] = sheet[: height - y, : width - x]
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (70, 80, 90), max(2, height // 40))
    return canvas


def whiteboard(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a whiteboard: what was wiped off badly, and writing and sketches on top."""
    canvas = to_image(tint(np.array([222.0, 224.0, 224.0]), 0.02 * noise(rng, height, width, height / 2, 4)))
    for _ in range(int(rng.integers(2, 5))):
        box = (int(rng.uniform(0.03, 0.6) * width), int(rng.uniform(0, 0.6) * height), width // 3, height // 3)
        prints.draw_text(rng, canvas, box, 0.09 * height)
    for _ in range(int(rng.integers(2, 6))):
        path = np.cumsum(rng.normal(0, 0.06 * height, (6, 2)), axis=0) + rng.uniform(0.2, 0.8, 2) * (width, height)
        colour = [float(shade) for shade in rng.uniform(20, 170, 3)]
        cv2.polylines(canvas, [path.astype(np.int32)], bool(rng.random() < 0.5), colour, 2, cv2.LINE_AA)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (150, 152, 152), max(2, height // 30))
    return canvas


def door_leaf(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a shut door: a frame, a smooth leaf, a handle, a kicking plate."""
    colour = random_colour(rng, 110, 190, 0.5)
    canvas = to_image(tint(colour, 0.025 * noise(rng, height, width, width / 2, 4)))
    thick = max(2, width // 22)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (0.6 * colour).tolist(), 2 * thick)
    cv2.rectangle(canvas, (2 * thick, height - 6 * thick), (width - 2 * thick, height), (150, 155, 155), -1)
    x, y = int(0.85 * width), height // 2
    cv2.rectangle(canvas, (x, y), (x + thick, y + 4 * thick), (165, 168, 170), -1)
    cv2.line(canvas, (x - 2 * thick, y), (x + thick, y), (60, 60, 60), thick, cv2.LINE_AA)
    return canvas


def _window(rng: np.random.Generator, height: int, width: int, frame: list[float], kind: int) -> Image:
    """Return one window: panes that mirror a pale sky above and something dark below, frame, bars, sill."""
    fall = np.linspace(1.0, 0.35, height, dtype=np.float32)[:, None]
    canvas = to_image(tint(np.array([105.0, 92.0, 80.0]), fall - 1 + 0.06 * noise(rng, height, width, width, 2)))
    if kind == 1:
        side = max(1, int(0.22 * width))
        curtain = np.array([185.0, 190.0, 195.0])
        folds = 0.1 * np.sin(np.arange(side, dtype=np.float32))[None].repeat(height, axis=0)
        canvas[:, :side] = canvas[:, -side:] = to_image(tint(curtain, folds))
    elif kind == 2:
        blind = int(0.6 * height)
        canvas[:blind] = (150, 158, 165)
        canvas[:blind:4] = (115, 122, 130)
    thick = max(1, width // 14)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), frame, thick)
    cv2.line(canvas, (width // 2, 0), (width // 2, height), frame, thick)
    cv2.line(canvas, (0, int(0.3 * height)), (width, int(0.3 * height)), frame, thick)
    canvas[-2 * thick :] = (0.8 * canvas[-2 * thick :] + 40).astype(np.uint8)
    return canvas


def front(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return the front of a house: render or brick, storeys of the same few windows, a door, perhaps a shop."""
    scale = pixels_per_metre
    if rng.random() < PLAIN_FRONTS:
        relief = 0.05 * noise(rng, height, width, 3 * scale, 4) + 0.02 * noise(rng, height, width, 4.0, 2)
        canvas = to_image(tint(random_colour(rng, 120, 215, 0.4), relief))
    else:
        canvas = plain.worn(rng, textures.brick(rng, height, width, scale), scale, (0.3, 0.6))
    shop = height - int(min(rng.uniform(2.9, 3.6), 0.5 * height / scale) * scale)
    storeys = max(1, round(shop / (3.0 * scale)))
    columns = max(2, round(width / (rng.uniform(1.7, 2.8) * scale)))
    size = (
        int(min(rng.uniform(1.2, 1.8) * scale, 0.7 * shop / storeys)),
        int(rng.uniform(0.45, 0.65) * width / columns),
    )
    frame = random_colour(rng, 60, 230, 0.3).tolist()
    windows = [_window(rng, *size, frame, kind) for kind in range(WINDOW_KINDS)]
    for storey in range(storeys):
        y = int((storey + 0.5) * shop / storeys - size[0] / 2)
        for column in range(columns):
            x = int((column + 0.5) * width / columns - size[1] / 2)
            canvas[y : y + size[0], x : x + size[1]] = windows[int(rng.choice(WINDOW_KINDS, p=(0.6, 0.25, 0.15)))]
        line = int((storey + 1) * shop / storeys) - 2
        cv2.line(canvas, (0, line), (width, line), (0.75 * canvas[max(0, line - 4), 2]).tolist(), 3)
    _ground_floor(rng, canvas[shop:], scale)
    streaks = noise(rng, max(2, height // 40), width, 0.4 * scale, 2)
    dirt = 0.045 * cv2.resize(streaks, (width, height)) + 0.05 * noise(rng, height, width, 2.5 * scale, 3)
    return to_image(canvas * (1 - np.abs(dirt))[..., None])


def _ground_floor(rng: np.random.Generator, canvas: Image, scale: float) -> None:
    """Draw a door and either shop windows with a name above or plain windows, in place."""
    height, width = canvas.shape[:2]
    base = int(0.5 * scale)
    canvas[-base:] = (0.7 * canvas[-base:]).astype(np.uint8)
    wide, tall = int(1.1 * scale), min(height - 4, int(2.3 * scale))
    door = int(rng.uniform(0.05, 0.95) * (width - wide))
    canvas[height - tall :, door : door + wide] = door_leaf(rng, tall, wide)
    is_shop = rng.random() < 0.4
    span, high = int((2.2 if is_shop else 1.2) * scale), int((1.9 if is_shop else 1.4) * scale)
    high = min(high, height - base - int(0.2 * scale))
    glass = _window(rng, high, span, random_colour(rng, 40, 200, 0.5).tolist(), 0)
    for x in range(int(0.4 * scale), width - span, int(1.35 * span)):
        if x + span > door - 4 and x < door + wide + 4:
            continue
        top = height - base - high - int(0.1 * scale)
        canvas[top : top + high, x : x + span] = glass
        if is_shop and rng.random() < 0.5:
            canvas[top + high // 3 : top + high, x + 8 : x + span // 3] = plain.muted(
                prints.poster(rng, high - high // 3, span // 3 - 8), 0.7
            )
    if is_shop:
        band = canvas[: max(12, int(0.45 * scale))]
        band[:] = random_colour(rng, 40, 200, 0.8).astype(np.uint8)
        prints.draw_text(rng, band, (int(0.2 * width), 0, int(0.6 * width), len(band)), 0.75 * len(band))
