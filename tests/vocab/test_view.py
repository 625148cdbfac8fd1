"""The view of a place: shifted, in another light, with contrast reversed, and against an independent computation."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.vocab import view
from seamark.vocab.errors import ObservationError
from seamark.vocab.view import View


def picture(seed: int, width: int = 400, height: int = 200) -> NDArray[np.uint8]:
    """Boxes of random grey on a ground: edges in some places and none in others."""
    rng = np.random.default_rng(seed)
    canvas = np.full((height, width), 120, np.uint8)
    for _ in range(25):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        w, h = rng.integers(10, 80, 2).tolist()
        cv2.rectangle(canvas, (x, y), (x + w, y + h), int(rng.integers(20, 235)), -1)
    return canvas


def likeness(a: View, b: View) -> float:
    return float(view.likeness_to_all(a, b.cells[None], b.totals[None])[0])


def test_an_image_is_most_like_itself_and_unlike_others() -> None:
    views = [view.describe(picture(seed)) for seed in range(12)]
    cells, totals = np.stack([v.cells for v in views]), np.stack([v.totals for v in views])
    for number, one in enumerate(views):
        values = view.likeness_to_all(one, cells, totals)
        assert values[number] == pytest.approx(1, abs=1e-5)
        assert (np.delete(values, number) < 0.6).all()
        assert ((values >= 0) & (values <= 1)).all()


def test_likeness_equals_the_best_correlation_of_shifted_windows() -> None:
    a, b = (view.describe(picture(seed)) for seed in (1, 2))
    correlations = []
    for shift in range(-4, 5):
        left, right = max(0, shift), 16 + min(0, shift)
        x = a.cells[:, left:right].astype(float)
        y = b.cells[:, left - shift : right - shift].astype(float)
        x[..., :4] -= x[..., :4].mean()
        y[..., :4] -= y[..., :4].mean()
        correlations.append((x * y).sum() / np.sqrt((x**2).sum() * (y**2).sum()))
    assert likeness(a, b) == pytest.approx(max(0.0, *correlations), abs=1e-4)
    assert likeness(a, b) == pytest.approx(likeness(b, a), abs=1e-5)


def test_a_camera_turned_aside_sees_the_same_place() -> None:
    wide = picture(3, 480)
    centre = view.describe(wide[:, 100:340])
    others = [likeness(centre, view.describe(picture(seed, 240))) for seed in range(20, 30)]
    for offset in (15, 30, 45, 60):  # up to four of sixteen columns of 15 pixels
        aside = view.describe(wide[:, 100 + offset : 340 + offset])
        assert 0.75 < likeness(centre, aside) <= 1
        assert likeness(centre, aside) > max(others) + 0.1


def test_light_changes_it_little_and_reversed_contrast_not_beyond_recognition() -> None:
    day = picture(4).astype(np.float32)
    lamp = 0.15 + np.exp(-(((np.mgrid[:200, :400] - [[[80]], [[150]]]) / 90.0) ** 2).sum(axis=0))
    rng = np.random.default_rng(0)
    night = np.clip(0.5 * day * lamp + rng.normal(0, 2, day.shape), 0, 255).astype(np.uint8)
    here = view.describe(day.astype(np.uint8))
    others = [likeness(here, view.describe(picture(seed))) for seed in range(40, 50)]
    assert max(others) + 0.1 < likeness(here, view.describe(night)) < 0.98
    assert max(others) < likeness(here, view.describe(255 - day.astype(np.uint8))) < 0.9


def test_an_image_without_edges_is_like_none() -> None:
    flat = view.describe(np.full((9, 9), 77, np.uint8))
    assert likeness(flat, flat) == 0
    assert likeness(flat, view.describe(picture(5))) == 0
    assert len(view.likeness_to_all(flat, np.zeros((0, 9, 16, 8), np.int8), np.zeros((0, 2, 16), np.float32))) == 0


def test_colour_hardly_matters() -> None:
    grey = picture(6)
    assert likeness(view.describe(grey), view.describe(np.dstack([grey] * 3))) > 0.999


@pytest.mark.parametrize("shape", [(0, 5), (5,), (5, 5, 4), (5, 5, 1)])
def test_refuses_what_is_no_image(shape: tuple[int, ...]) -> None:
    with pytest.raises(ObservationError, match="thumbnail"):
        view.describe(np.zeros(shape, np.uint8))
    with pytest.raises(ObservationError, match="thumbnail"):
        view.describe(np.zeros((5, 5), np.float32))  # type: ignore[arg-type]
