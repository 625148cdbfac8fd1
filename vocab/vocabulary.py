"""Visual words: the words, their weights, and the nearest word of a descriptor."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.vocab import store
from seamark.vocab.errors import ObservationError, VocabularyFileError
from seamark.vocab.kernels import native

DESCRIPTOR_SIZE = 128
MIN_IDF = 1e-3  # a word seen in every training image hardly speaks, but an image of such words is still comparable


@dataclass(frozen=True, eq=False)
class Cells:
    """A coarse level over words that are sorted by cell, so that a descriptor is compared with few of them.

    ``centres`` (m, 128) uint8; the words of cell c are ``offsets[c]..offsets[c + 1]``, ``offsets`` (m + 1,) int64. A
    descriptor looks into the ``beam`` cells of the nearest centres, but not into those whose squared distance exceeds
    the nearest one's by more than ``reach``.
    """

    centres: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    beam: int
    reach: int


class Vocabulary:
    """A set of visual words (Sivic and Zisserman, Video Google, ICCV 2003) over RootSIFT descriptors.

    ``words`` (n_words, 128) uint8 are the centres of the clusters, ``idf`` (n_words,) float32 the inverse document
    frequencies over the training images, ``provenance`` what the training left to know, ``cells`` the tree if there is
    one, ``extras`` further arrays by name that travel with the words (as a Hamming embedding needs them). All arrays
    are read-only.
    """

    def __init__(
        self,
        words: NDArray[np.uint8],
        idf: NDArray[np.float32],
        provenance: Mapping[str, Any] | None = None,
        *,
        cells: Cells | None = None,
        extras: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        if words.ndim != 2 or words.shape[1] != DESCRIPTOR_SIZE or words.dtype != np.uint8 or not len(words):
            raise ObservationError(f"words must be (n, {DESCRIPTOR_SIZE}) uint8, not {words.shape} {words.dtype}")
        if idf.shape != (len(words),) or idf.dtype != np.float32:
            raise ObservationError(f"idf must be ({len(words)},) float32, not {idf.shape} {idf.dtype}")
        if not (np.isfinite(idf).all() and (idf > 0).all()):
            raise ObservationError("every idf must be positive and finite")
        if cells is not None:
            _check_cells(cells, len(words))
        self.words = _read_only(words)
        self.idf = _read_only(idf)
        self.provenance = MappingProxyType(dict(provenance or {}))
        self.cells = cells
        self.extras = MappingProxyType({name: _read_only(array) for name, array in (extras or {}).items()})
        self._hash: str | None = None
        self._quantiser: native.Quantiser | None = None

    @property
    def n_words(self) -> int:
        """Return the number of words."""
        return len(self.words)

    @property
    def hash(self) -> str:
        """Return the SHA-256 of words, weights, cells and extras in hex: what an index says it was built with."""
        if self._hash is None:
            digest = hashlib.sha256(b"seamark vocabulary\0")
            for name, array in self._sections().items():
                if name not in ("words", "idf"):
                    digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode())
                digest.update(np.ascontiguousarray(array).data)
            self._hash = digest.hexdigest()
        return self._hash

    def assign(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the nearest word of each descriptor in Euclidean distance, the lowest of equally near ones.

        ``descriptors`` (N, 128) uint8; the result is (N,) int32. Exact without cells; with the cells of the default
        vocabulary 95 % of the descriptors of unseen photographs get their nearest word in a fortieth of the time, the
        others one that is 1 to 5 % farther. May be called from several threads.

        Raises:
            ObservationError: descriptors of another shape or type.
        """
        words: NDArray[np.int32] = self.assign_soft(descriptors, 1)[0][:, 0]
        return words

    def assign_soft(self, descriptors: NDArray[np.uint8], k: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the ``k`` nearest words of each descriptor, nearest first, and their squared distances, (N, k) int32.

        Where the cells that were looked into hold fewer words, the rest is word -1 with the greatest distance there is.

        Raises:
            ObservationError: descriptors of another shape or type.
        """
        check_descriptors(descriptors)
        if self._quantiser is None:
            none, all_words = np.zeros((0, DESCRIPTOR_SIZE), np.uint8), np.array([0, self.n_words], np.int64)
            centres, offsets = (self.cells.centres, self.cells.offsets) if self.cells else (none, all_words)
            self._quantiser = native.Quantiser(self.words, centres, offsets)
        beam, reach = (self.cells.beam, self.cells.reach) if self.cells else (1, 0)
        return self._quantiser.assign(np.ascontiguousarray(descriptors), k, beam, reach)

    def save(self, path: Path | str) -> None:
        """Write the vocabulary to a file, replacing an older one only when the new one is complete on disk.

        Raises:
            VocabularyFileError: the file cannot be written.
        """
        store.write(Path(path), self._sections(), self.provenance)

    @classmethod
    def load(cls, path: Path | str) -> "Vocabulary":
        """Read a vocabulary from a file; the words stay mapped to the file.

        Raises:
            VocabularyFileError: the file is missing, damaged, or of an unknown version.
        """
        sections, provenance = store.read(Path(path))
        try:
            words, idf = sections.pop("words"), sections.pop("idf")
            cells = None
            if "cell_centres" in sections:
                beam, reach = (int(value) for value in sections.pop("cell_search"))
                cells = Cells(sections.pop("cell_centres"), sections.pop("cell_offsets"), beam, reach)
            return cls(words, idf, provenance, cells=cells, extras=sections)
        except (KeyError, ValueError, ObservationError) as error:
            raise VocabularyFileError(f"{path}: damaged vocabulary: {error}") from error

    @classmethod
    def default(cls) -> "Vocabulary":
        """Return the vocabulary that ships; benchmarks/train_default_vocabulary.py trained it, on no photograph.

        Raises:
            VocabularyFileError: the installation is damaged.
        """
        return cls.load(Path(__file__).with_name("default.vocab"))

    def _sections(self) -> dict[str, NDArray[Any]]:
        sections: dict[str, NDArray[Any]] = {"words": self.words, "idf": self.idf}
        if self.cells is not None:
            sections["cell_centres"], sections["cell_offsets"] = self.cells.centres, self.cells.offsets
            sections["cell_search"] = np.array([self.cells.beam, self.cells.reach], np.int64)
        return sections | dict(sorted(self.extras.items()))


def check_descriptors(descriptors: NDArray[np.uint8]) -> None:
    """Raise ObservationError unless the descriptors are (N, 128) uint8."""
    if descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_SIZE or descriptors.dtype != np.uint8:
        shape, kind = descriptors.shape, descriptors.dtype
        raise ObservationError(f"descriptors must be (N, {DESCRIPTOR_SIZE}) uint8, not {shape} {kind}")


def inverse_document_frequency(document_frequency: NDArray[np.int64], n_documents: int) -> NDArray[np.float32]:
    """Return ln(documents / documents with the word) for each word (n,) float32, at least MIN_IDF.

    ``document_frequency`` is (n,); a word in no document counts as if it were in one.
    """
    idf = np.log(max(n_documents, 1) / np.maximum(document_frequency, 1.0))
    return np.maximum(idf, MIN_IDF).astype(np.float32)


def _check_cells(cells: Cells, n_words: int) -> None:
    centres, offsets = cells.centres, cells.offsets
    if centres.ndim != 2 or centres.shape[1] != DESCRIPTOR_SIZE or centres.dtype != np.uint8 or len(centres) < 2:
        raise ObservationError(
            f"cell centres must be (m, {DESCRIPTOR_SIZE}) uint8, not {centres.shape} {centres.dtype}"
        )
    rising = offsets.dtype == np.int64 and offsets.shape == (len(centres) + 1,) and (np.diff(offsets) >= 0).all()
    if not rising or offsets[0] != 0 or offsets[-1] != n_words:
        raise ObservationError(f"cell offsets must be ({len(centres) + 1},) int64 and rise from 0 to {n_words}")
    if not (1 <= cells.beam <= len(centres) and 0 <= cells.reach < 2**31):
        raise ObservationError(f"cannot look into {cells.beam} of {len(centres)} cells within {cells.reach}")


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.setflags(write=False)
    return view
