"""The inverted file: from words to the places that show them."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import ObservationError, UnknownPlaceError
from seamark.vocab.kernels import native

MOST_COUNTED: Final = 255
"""A word seen more often in an image counts as if it were seen so often."""

SIGNATURE_BITS: Final = 64
MOST_PLACES: Final = 65536
"""Places per block: a posting names its place by 16 bits."""


class InvertedIndex:
    """Votes of visual words for places, tf-idf weighted, incremental, with removal.

    A place is a vector of weights, sqrt(count) * idf for each word; the similarity of two is the sum of the smaller
    weights divided by the greater sum of either, 1 for equal places and 0 for places without a common word. The square
    root tempers words that come in bursts (Jegou et al., CVPR 2009). On gardens_point, recall@1/@5/@10 with 16k words:
    .72/.925/.99; the same with weights that sum to one (Nister and Stewenius, CVPR 2006) .695/.92/.99, the cosine
    .665/.885/.94, the cosine of words without counts .69/.915/.97. Weights do not follow the document frequencies of
    the index: so a score depends on two images alone, and rankings of shards merge exactly.

    With signatures each descriptor brings 64 bits that say where in its word it lies (Hamming embedding, Jegou, Douze
    and Schmid, ECCV 2008) and, with geometry, the orientation (256 units for the whole circle) and scale (16 units for
    one bin of 16, of any base) of its feature: see :meth:`near_votes`.

    Postings lie in blocks of 65,536 places (2 bytes for a word seen once, 3 for others; 8 more with signatures, 2 with
    geometry), immutable but for the newest. A place has a slot, a small number given by :meth:`add`. A removed place
    keeps its slot and its postings until :meth:`compact`. One thread may write while others read.

    ``level`` is one of ``native.levels()``, the processor's best by default; all give the same bits.
    """

    def __init__(
        self,
        idf: NDArray[np.float32],
        *,
        with_signatures: bool = False,
        with_geometry: bool = False,
        block_places: int = MOST_PLACES,
        level: str | None = None,
    ) -> None:
        self._idf = idf
        self.with_signatures = with_signatures
        self.with_geometry = with_geometry
        self.block_places = block_places
        counts = np.maximum(np.arange(MOST_COUNTED + 1), 1)
        weights = np.sqrt(counts).astype(np.float32)
        # Where every descriptor has a posting of its own, the postings of a word share its weight.
        shares = (1.0 / counts if with_signatures else np.ones(len(counts))).astype(np.float32)
        self._postings = native.Postings(len(idf), weights, shares, block_places, with_signatures, with_geometry, level)

    def __len__(self) -> int:
        """Return the number of places."""
        return self._postings.n_live

    @property
    def n_slots(self) -> int:
        """Return the number of slots, those of removed places included: the length of :meth:`votes`."""
        return self._postings.n_slots

    @property
    def n_bytes(self) -> int:
        """Return how many bytes the posting lists take, in memory or mapped."""
        return self._postings.n_bytes

    def add(
        self,
        words: NDArray[np.int32],
        signatures: NDArray[np.uint64] | None = None,
        geometry: NDArray[np.uint16] | None = None,
    ) -> int:
        """Add a place that shows ``words`` (N,) int32, in any order, and return its slot.

        ``signatures`` (N,) uint64 and ``geometry`` (N,) uint16, orientation in the low byte and scale in the high one,
        belong to an index that has them.

        Raises:
            ObservationError: a word that is not in the vocabulary, or an array that is missing, superfluous or wrong.
        """
        self._check(words, signatures, geometry, self.with_signatures, self.with_geometry)
        present, count = _counted(words)
        mass = self._mass(present, count)
        codes = np.minimum(count, MOST_COUNTED)
        if not self.with_signatures:
            return self._postings.add(present, codes.astype(np.uint8), mass)
        order = np.argsort(words, kind="stable")
        each = np.repeat(codes, count).astype(np.uint8)
        return self._postings.add(words[order], each, mass, _sorted(signatures, order), _sorted(geometry, order))

    def votes(self, words: NDArray[np.int32], nearest: NDArray[np.int32] | None = None) -> NDArray[np.float32]:
        """Return the similarity, 0..1, of an image that shows ``words`` (N,) int32 to the place in each slot.

        The result is (n_slots,) float32; the slots of removed places hold 0. Where ``words`` are several for each
        descriptor (soft assignment), ``nearest`` are the words that count as what the image shows.

        Raises:
            ObservationError: a word that is not in the vocabulary.
        """
        self._check(words, None, None, False, False)
        present, count = _counted(words)
        most = np.sqrt(count).astype(np.float32)
        mass = self._mass(present, count) if nearest is None else self._mass(*_counted(nearest))
        return self._postings.votes(present, self._idf[present], most, mass)

    def near_votes(
        self,
        words: NDArray[np.int32],
        signatures: NDArray[np.uint64],
        table: NDArray[np.float32],
        geometry: NDArray[np.uint16] | None = None,
    ) -> NDArray[np.float32]:
        """Return votes of pairs of descriptors, each weighed by ``table`` (65,) float32 at its Hamming distance.

        A pair of one word counts idf / sqrt(count in one image * count in the other) times its entry in the table, and
        the sum is divided as in :meth:`votes`. Entries fall from 1 to zero, so that only pairs count that are near
        within their word. With ``geometry`` orientation and scale must agree as well (weak geometric consistency, same
        paper): the votes of a place are told apart by difference of orientation and of scale, 16 bins each, and the
        fullest bin of each counts, the lesser of both.

        Raises:
            ObservationError: a word that is not in the vocabulary, an array that is wrong, or an index without them.
        """
        if not self.with_signatures or (geometry is not None and not self.with_geometry):
            raise ObservationError("this index was made without the signatures or the geometry that were asked for")
        self._check(words, signatures, geometry, True, geometry is not None)
        if table.shape != (SIGNATURE_BITS + 1,) or table.dtype != np.float32 or not np.isfinite(table).all():
            raise ObservationError(f"table must be (65,) float32 and finite, not {table.shape} {table.dtype}")
        order = np.argsort(words, kind="stable")
        present, count = _counted(words)
        weights = np.repeat((self._idf[present] / np.sqrt(count)).astype(np.float32), count)
        mass = self._mass(present, count)
        return self._postings.near_votes(
            words[order], weights, mass, signatures[order], np.ascontiguousarray(table), _sorted(geometry, order)
        )

    def remove(self, slot: int) -> None:
        """Forget the place in a slot. Its postings are passed over from now on and go with :meth:`compact`.

        Raises:
            UnknownPlaceError: the slot holds none.
        """
        if not self._postings.remove(slot):
            raise UnknownPlaceError(f"slot {slot} holds no place")

    def compact(self) -> NDArray[np.int32]:
        """Let go of removed places and number the slots anew; return the old slot of each new one (len(self),) int32.

        Costs about a pass over all postings; others may read meanwhile.
        """
        return self._postings.compact()

    def snapshot(self) -> Any:
        """Return blocks, masses and marks of the living as they are now, for :mod:`seamark.vocab.index_file`."""
        return self._postings.snapshot()

    def attach(self, blocks: Any, masses: NDArray[np.float32], live: NDArray[np.uint8]) -> None:
        """Take over what :meth:`snapshot` gave, without copying the postings; raises ValueError if it does not fit."""
        self._postings.attach(blocks, masses, live)

    def _mass(self, present: NDArray[np.int32], count: NDArray[np.intp]) -> float:
        return float((np.sqrt(np.minimum(count, MOST_COUNTED)) * self._idf[present]).sum())

    def _check(self, words: Any, signatures: Any, geometry: Any, want_signatures: bool, want_geometry: bool) -> None:
        if words.ndim != 1 or words.dtype != np.int32:
            raise ObservationError(f"words must be (N,) int32, not {words.shape} {words.dtype}")
        if len(words) and (words.min() < 0 or words.max() >= len(self._idf)):
            raise ObservationError(f"words must be in 0..{len(self._idf) - 1}, not {words.min()}..{words.max()}")
        wanted = (
            ("signatures", signatures, want_signatures, np.uint64),
            ("geometry", geometry, want_geometry, np.uint16),
        )
        for name, array, want, kind in wanted:
            if (array is not None) != want:
                raise ObservationError(f"{name} must be given to an index that has them, and to no other")
            if want and (array.shape != words.shape or array.dtype != kind):
                raise ObservationError(
                    f"{name} must be {words.shape} {np.dtype(kind)}, not {array.shape} {array.dtype}"
                )


def best(scores: NDArray[np.float32], limit: int) -> NDArray[np.int32]:
    """Return the slots of the ``limit`` highest of ``scores`` (N,), best first, the lower slot of equal ones."""
    return native.top(np.ascontiguousarray(scores, np.float32), limit)


def _counted(words: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    return np.unique(words, return_counts=True)


def _sorted(array: NDArray[Any] | None, order: NDArray[np.intp]) -> NDArray[Any] | None:
    return None if array is None else array[order]
