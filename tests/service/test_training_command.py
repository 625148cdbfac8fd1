"""`seamark vocab train` interrupted and begun again."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.frontend.config import FrontendConfig
from seamark.service import training
from seamark.service.sources.base import Source
from seamark.service.sources.open import open_sources

COUNT, STOPPED_AT, CHECKPOINT = 12, 8, 5


@pytest.fixture
def images(tmp_path: Path) -> Source:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(COUNT):
        picture = np.random.default_rng(number).integers(0, 256, (30, 40)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(picture, (160, 120), interpolation=cv2.INTER_CUBIC))
    return open_sources([str(folder)], mode="places")


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Counts the images of which features are looked for."""
    monkeypatch.setattr("seamark.vocab.training.CHECKPOINT_IMAGES", CHECKPOINT)
    seen: list[int] = []
    extract = training.extract_features

    def counting(image: np.ndarray, *arguments: object, **named: object) -> object:
        seen.append(len(seen))
        return extract(image, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(training, "extract_features", counting)
    yield seen


def interrupt_at(count: int) -> Callable[[str, int], None]:
    def progress(stage: str, done: int) -> None:
        if stage == "reading" and done == count:
            raise KeyboardInterrupt

    return progress


def test_it_goes_on_where_it_was_interrupted(images: Source, looked_at: list[int], tmp_path: Path) -> None:
    """Test: stopped after 8 of 12 images, 5 of which were kept. Expected: the other 7 are read, the words the same."""
    config, out = FrontendConfig(), tmp_path / "words.vocab"
    with pytest.raises(KeyboardInterrupt):
        training.train_vocabulary(images, 30, out, seed=1, config=config, progress=interrupt_at(STOPPED_AT))
    assert not out.exists() and training.checkpoint_path(images, out, 1, config).exists()
    looked_at.clear()
    resumed = training.train_vocabulary(images, 30, out, seed=1, config=config)
    assert len(looked_at) == COUNT - CHECKPOINT
    assert not list(tmp_path.glob(".words*"))
    assert resumed.hash == training.train_vocabulary(images, 30, tmp_path / "again", seed=1, config=config).hash


@pytest.mark.parametrize("seed, contrast", [(2, 0.02), (1, 0.05)])
def test_another_training_begins_anew(
    images: Source, looked_at: list[int], tmp_path: Path, seed: int, contrast: float
) -> None:
    out, config = tmp_path / "words.vocab", FrontendConfig(sift_contrast=0.02)
    with pytest.raises(KeyboardInterrupt):
        training.train_vocabulary(images, 30, out, seed=1, config=config, progress=interrupt_at(STOPPED_AT))
    looked_at.clear()
    training.train_vocabulary(images, 30, out, seed=seed, config=FrontendConfig(sift_contrast=contrast))
    assert len(looked_at) == COUNT
