"""The places seen so far, and which of them an image may show."""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.vocab import histogram, index_file, signatures, view
from seamark.vocab.config import VocabConfig
from seamark.vocab.errors import DuplicatePlaceError, IndexFileError, ObservationError, UnknownPlaceError
from seamark.vocab.histogram import Histograms
from seamark.vocab.inverted_index import InvertedIndex
from seamark.vocab.types import Candidate, Candidates, PlaceObservation
from seamark.vocab.view import View
from seamark.vocab.vocabulary import Vocabulary, check_descriptors

NANOSECONDS = 1_000_000_000
NO_PLACE = -1
NEAR_VOTES = signatures.vote_table()
SAME_WORDS = 1e-4  # what sums of float32 may lack of 1
COMPACT_FROM = 64  # removed places; fewer are kept, however few others there are


class PlaceIndex:
    """Ranks all places by how much they look like an image: votes of visual words, colour histograms, and the view.

    The score is the weighted mean of the votes, of 1 - J / (2 ln 2), J the Jeffrey divergence, and of the likeness of
    the view; see VocabConfig for the weights. It depends on two images alone, so that rankings of shards merge. The
    recent past of the image's own session is never a candidate, by time, by number and for as long as the view has
    hardly changed, nor is the image itself. With ``config.signatures`` only features vote that are alike within their
    word (Hamming embedding), with ``config.geometry`` only those of them whose scale and orientation have changed as
    most have (weak geometric consistency).
    """

    def __init__(self, vocabulary: Vocabulary, config: VocabConfig | None = None) -> None:
        self.vocabulary = vocabulary
        self.config = config or VocabConfig()
        self._inverted = InvertedIndex(
            vocabulary.idf, with_signatures=self.config.signatures, with_geometry=self.config.geometry
        )
        self._directions = signatures.directions(vocabulary) if self.config.signatures else None
        self._slot_of: dict[int, int] = {}
        self._added_to: dict[int, int] = {}  # session -> places ever added to it
        self._table = np.zeros(0, _place_type(self.config.histogram_bins))
        self._changing = threading.Lock()  # held while places change, so that a file holds one moment
        self._opened: index_file.IndexFile | None = None  # until the first use, which verifies and reads it

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._slot_of)

    def __contains__(self, place_id: int) -> bool:
        """Return whether the place is in the index."""
        return place_id in self._slot_of

    def step(self, observation: PlaceObservation) -> Candidates:
        """Rank the places that a keyframe may show, then add it as a place of its own.

        Raises:
            DuplicatePlaceError: its id is in the index already; nothing changes.
            ObservationError: arrays of the wrong shape or type; nothing changes.
        """
        self._read_opened()
        self._refuse_known(observation.id)
        looks = self._describe(observation)
        candidates = self._rank(observation, looks, self.config.candidates)
        self._insert(observation, looks)
        return candidates

    def add(self, observation: PlaceObservation) -> None:
        """Add a place.

        Raises:
            DuplicatePlaceError: its id is in the index already; nothing changes.
            ObservationError: arrays of the wrong shape or type; nothing changes.
        """
        self._read_opened()
        self._refuse_known(observation.id)
        self._insert(observation, self._describe(observation))

    def query(self, observation: PlaceObservation, limit: int | None = None) -> Candidates:
        """Rank the places that an image may show: at most ``limit`` (default: the configuration's), best first.

        Raises:
            ObservationError: arrays of the wrong shape or type.
        """
        self._read_opened()
        limit = self.config.candidates if limit is None else limit
        return self._rank(observation, self._describe(observation), limit)

    def remove(self, place_id: int) -> None:
        """Forget a place; its id may be added again.

        Raises:
            UnknownPlaceError: the index holds no such place.
        """
        self._read_opened()
        if place_id not in self._slot_of:
            raise UnknownPlaceError(f"place {place_id} is not in the index")
        with self._changing:
            slot = self._slot_of.pop(place_id)
            self._inverted.remove(slot)
            self._table[slot]["id"] = NO_PLACE
            self._table[slot]["live"] = False
            if self._inverted.n_slots > 2 * len(self._slot_of) + COMPACT_FROM:
                self._compact()

    def stamps(self) -> dict[int, tuple[int, int]]:
        """Return session and stamp of every place by its id."""
        self._read_opened()
        live = self._table[list(self._slot_of.values())]
        sessions, stamps_ns = live["session"].tolist(), live["stamp_ns"].tolist()
        return dict(zip(self._slot_of, zip(sessions, stamps_ns, strict=True), strict=True))

    def describes(self, observation: PlaceObservation) -> bool:
        """Return whether the place of this id was made of just this observation, with these settings.

        Raises:
            ObservationError: arrays of the wrong shape or type.
        """
        slot = self._slot_of.get(observation.id)
        if slot is None:
            return False
        self._read_opened()
        looks, place = self._describe(observation), self._table[slot]
        pairs = (
            (looks.histograms.present, place["present"]),
            (looks.histograms.values, place["values"]),
            (looks.view.cells, place["cells"]),
            (looks.view.totals, place["totals"]),
        )
        if (observation.session, observation.stamp_ns) != (place["session"], place["stamp_ns"]):
            return False
        alike = not len(looks.words) or self._inverted.votes(looks.words)[slot] > 1.0 - SAME_WORDS
        return bool(alike) and all(np.array_equal(one, other) for one, other in pairs)

    def save(self, path: Path | str) -> None:
        """Write the index to a file, replacing an older one only when the new one is complete on disk.

        May run in a thread of its own: queries go on, additions wait only while the newest block is copied.

        Raises:
            IndexFileError: the file cannot be written.
        """
        self._read_opened()
        with self._changing:
            snapshot = self._inverted.snapshot()
            table = self._table[: len(snapshot[1])].copy()
            facts = {"added_to": {str(session): count for session, count in self._added_to.items()}}
        columns = {f"table.{name}": table[name] for name in table.dtype.names or ()}
        index_file.save(Path(path), self.vocabulary.hash, self._inverted, snapshot, facts, columns)

    @classmethod
    def load(cls, path: Path | str, vocabulary: Vocabulary, config: VocabConfig | None = None) -> "PlaceIndex":
        """Open an index that :meth:`save` wrote; its postings stay mapped to the file.

        Damage to the postings and descriptions is found at the first use, which raises IndexFileError too.

        Raises:
            IndexFileError: the file is missing, damaged, or was made with another vocabulary or other settings.
        """
        opened = index_file.load(Path(path))
        if opened.vocabulary_hash != vocabulary.hash:
            made, given = opened.vocabulary_hash[:16], vocabulary.hash[:16]
            raise IndexFileError(f"{path}: made with the vocabulary {made}, not with {given}")
        index = cls(vocabulary, config)
        index._inverted = opened.inverted_index(vocabulary.idf)
        for name in ("signatures", "geometry"):
            there = getattr(index._inverted, f"with_{name}")
            if there != getattr(index.config, name):
                raise IndexFileError(f"{path}: made with other settings: {'with' if there else 'without'} {name}")
        for name, (kind, _) in (index._table.dtype.fields or {}).items():
            shape = opened.array(f"table.{name}", verify=False).shape
            if shape != (index._inverted.n_slots, *kind.shape):
                raise IndexFileError(f"{path}: made with other settings: {name} is {shape}")
        ids, live = opened.array("table.id"), opened.array("table.live")
        index._slot_of = {int(ids[slot]): int(slot) for slot in np.flatnonzero(live)}
        index._added_to = {int(session): int(count) for session, count in opened.facts["added_to"].items()}
        index._opened = opened
        return index

    def _read_opened(self) -> None:
        if self._opened is None:
            return
        with self._changing:
            if self._opened is None:
                return
            self._opened.verify_postings()
            table: NDArray[Any] = np.zeros(self._inverted.n_slots, self._table.dtype)
            for name in table.dtype.names or ():
                table[name] = self._opened.array(f"table.{name}")
            self._table, self._opened = table, None

    def _compact(self) -> None:
        self._table = self._table[self._inverted.compact()]
        self._slot_of = {int(place_id): slot for slot, place_id in enumerate(self._table["id"])}

    def _refuse_known(self, place_id: int) -> None:
        if place_id in self._slot_of:
            raise DuplicatePlaceError(f"place {place_id} is in the index already")

    def _describe(self, observation: PlaceObservation) -> "_Looks":
        check_descriptors(observation.descriptors)
        bins, sigma_bins = self.config.histogram_bins, self.config.histogram_sigma_bins
        histograms = histogram.describe(observation.thumbnail, bins, sigma_bins)
        descriptors = observation.descriptors[: self.config.max_descriptors]
        nearest, _ = self.vocabulary.assign_soft(descriptors, self.config.soft_words)
        words, signed = np.ascontiguousarray(nearest[:, 0]), None
        if self._directions is not None:
            signed = signatures.sign(descriptors, self.vocabulary.words, words, self._directions)
        geometry = _geometry(observation)[: len(words)] if self.config.geometry else None
        views = view.describe(observation.thumbnail)
        return _Looks(words, nearest[nearest >= 0], signed, geometry, histograms, views)

    def _insert(self, observation: PlaceObservation, looks: "_Looks") -> None:
        with self._changing:
            slot = self._inverted.add(looks.words, looks.signatures, looks.geometry)
            if slot >= len(self._table):
                more = max(64, len(self._table) // 2)
                self._table = np.concatenate([self._table, np.zeros(more, self._table.dtype)])
            ordinal = self._added_to.get(observation.session, 0)
            self._table[slot] = (
                observation.id,
                observation.session,
                observation.stamp_ns,
                ordinal,
                True,
                looks.histograms.present,
                looks.histograms.values,
                looks.view.cells,
                looks.view.totals,
            )
            self._added_to[observation.session] = ordinal + 1
            self._slot_of[observation.id] = slot

    def _rank(self, observation: PlaceObservation, looks: "_Looks", limit: int) -> Candidates:
        votes = self._votes(looks).astype(np.float64)
        places = self._table[: len(votes)]
        jeffrey = histogram.divergence_to_all(looks.histograms, places["values"], places["present"]).astype(np.float64)
        likeness = view.likeness_to_all(looks.view, places["cells"], places["totals"]).astype(np.float64)
        score = self._fuse(votes * min(1.0, len(looks.words) / self.config.trusted_features), jeffrey, likeness)
        slots = np.flatnonzero(self._eligible(observation, places, votes))
        if len(slots) > limit > 0:  # spare the sort of all: nothing below the limit-th score can be ranked
            threshold = np.partition(score[slots], len(slots) - limit)[len(slots) - limit]
            slots = slots[score[slots] >= threshold]
        slots = slots[np.lexsort((places["id"][slots], -score[slots]))][:limit]
        ranked = tuple(
            Candidate(int(places["id"][s]), float(score[s]), float(votes[s]), float(jeffrey[s]), float(likeness[s]))
            for s in slots
        )
        return Candidates(observation.id, observation.stamp_ns, ranked)

    def _votes(self, looks: "_Looks") -> NDArray[np.float32]:
        if looks.signatures is None:
            return self._inverted.votes(looks.soft_words, looks.words)
        return self._inverted.near_votes(looks.words, looks.signatures, NEAR_VOTES, looks.geometry)

    def _fuse(
        self, votes: NDArray[np.float64], jeffrey: NDArray[np.float64], likeness: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        config = self.config
        by_colour = config.histogram_weight * (1.0 - jeffrey / histogram.MAX_DIVERGENCE)
        total = config.votes_weight * votes + by_colour + config.view_weight * likeness
        fused: NDArray[np.float64] = total / (config.votes_weight + config.histogram_weight + config.view_weight)
        return np.clip(fused, 0.0, 1.0)

    def _eligible(
        self, observation: PlaceObservation, places: NDArray[Any], votes: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        same_session = places["live"] & (places["session"] == observation.session)
        age_ns = np.abs(places["stamp_ns"] - observation.stamp_ns)
        near = age_ns < round(self.config.exclude_recent_s * NANOSECONDS)
        last = self._added_to.get(observation.session, 0) - self.config.exclude_recent_count
        recent = same_session & (near | (places["ordinal"] >= last))
        recent[self._covisible(np.flatnonzero(same_session), places, votes)] = True
        eligible: NDArray[np.bool_] = places["live"] & ~recent & (places["id"] != observation.id)
        return eligible

    def _covisible(self, slots: NDArray[np.intp], places: NDArray[Any], votes: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return those of a session's ``slots``, its last ones, since which the view has hardly changed."""
        newest_first = slots[np.argsort(-places["ordinal"][slots])]
        changed = np.flatnonzero(votes[newest_first] < self.config.exclude_covisible)
        return newest_first[: changed[0]] if len(changed) else newest_first


@dataclass(frozen=True, eq=False)
class _Looks:
    """What the index compares of an image."""

    words: NDArray[np.int32]
    soft_words: NDArray[np.int32]  # with soft assignment several of each feature
    signatures: NDArray[np.uint64] | None
    geometry: NDArray[np.uint16] | None
    histograms: Histograms
    view: View


def _geometry(observation: PlaceObservation) -> NDArray[np.uint16]:
    for name in ("scales", "angles"):
        values, n = getattr(observation, name), len(observation.descriptors)
        if values is None or values.shape != (n,) or values.dtype != np.float32 or not np.isfinite(values).all():
            raise ObservationError(f"{name} must be ({n},) float32 and finite where the index compares geometry")
    assert observation.angles is not None and observation.scales is not None
    return signatures.geometry(observation.angles, observation.scales)


def _place_type(bins: int) -> np.dtype[Any]:
    channels = len(histogram.CHANNELS)
    return np.dtype(
        [
            ("id", np.int64),
            ("session", np.int64),
            ("stamp_ns", np.int64),
            ("ordinal", np.int64),
            ("live", np.bool_),
            ("present", np.bool_, channels),
            ("values", np.float32, (channels, bins)),
            ("cells", np.int8, (view.ROWS, view.COLUMNS, view.ORIENTATIONS)),
            ("totals", np.float32, (2, view.COLUMNS)),
        ],
        align=True,
    )
