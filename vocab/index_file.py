"""The place index on disk: written while queries go on, mapped when it is opened.

Layout, little-endian: magic (8 bytes), version (u32), length of the header (u32), SHA-256 (32 bytes) of those 16 bytes
and of the header; the header, JSON in UTF-8 filled with blanks up to a multiple of 64 bytes from the start of the file;
then the sections. The header holds ``vocabulary`` (its hash), ``facts`` (JSON of the owner), ``index`` (the kind of the
inverted index), and ``sections``: by name, ``dtype``, ``shape``, ``offset`` (a multiple of 64) and ``sha256`` of each.

Opening verifies the header and the small sections: everything but the postings themselves. Those are verified once, all
of them, before the first use: it reads what the first queries would read anyway, so no answer ever rests on a bit that
was not checked, and opening does not wait for the disk.
"""

import hashlib
import json
import mmap
import struct
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from seamark.vocab import store
from seamark.vocab.errors import IndexFileError, VocabularyFileError
from seamark.vocab.inverted_index import InvertedIndex

MAGIC: Final = b"SMPLACES"
VERSION: Final = 1
ALIGNMENT: Final = 64
_PREAMBLE: Final = struct.Struct("<8sII")
_HEADER_START: Final = _PREAMBLE.size + hashlib.sha256().digest_size
_STREAMS: Final = ("starts", "ids", "codes", "signatures", "geometry")
_POSTINGS: Final = ("ids", "codes", "signatures", "geometry")

Snapshot = tuple[list[Any], NDArray[np.float32], NDArray[np.uint8]]


class IndexFile:
    """A place index that was opened: what it holds, and the inverted index mapped to it."""

    def __init__(self, path: Path, content: mmap.mmap, header: Mapping[str, Any]) -> None:
        self.path = path
        self.vocabulary_hash = str(header["vocabulary"])
        self.facts: Mapping[str, Any] = header["facts"]
        self._index: Mapping[str, Any] = header["index"]
        self._content = content
        self._table: Mapping[str, Mapping[str, Any]] = header["sections"]
        self._verified = False
        self._lock = threading.Lock()

    def array(self, name: str, *, verify: bool = True) -> NDArray[Any]:
        """Return a section, mapped and read-only.

        Raises:
            IndexFileError: there is none of this name or it is damaged.
        """
        if name not in self._table:
            raise IndexFileError(f"{self.path}: damaged place index: no section {name}")
        entry = self._table[name]
        kind, shape, offset = np.dtype(entry["dtype"]), tuple(entry["shape"]), entry["offset"]
        try:
            array = np.frombuffer(self._content, kind, int(np.prod(shape)), offset).reshape(shape)
        except ValueError as error:
            raise IndexFileError(f"{self.path}: damaged place index: section {name}: {error}") from error
        if verify and hashlib.sha256(array.data if array.size else b"").hexdigest() != entry["sha256"]:
            raise IndexFileError(f"{self.path}: damaged place index: the checksum of {name} does not agree")
        return array

    def inverted_index(self, idf: NDArray[np.float32]) -> InvertedIndex:
        """Return the posting lists, mapped to the file.

        Raises:
            IndexFileError: the file is damaged.
        """
        kind, blocks = self._index, []
        try:
            index = InvertedIndex(
                idf,
                with_signatures=bool(kind["with_signatures"]),
                with_geometry=bool(kind["with_geometry"]),
                block_places=int(kind["block_places"]),
            )
            for number, n_places in enumerate(kind["blocks"]):
                names = [f"block{number}.{stream}" for stream in _STREAMS]
                arrays = [
                    self.array(name, verify=name.endswith("starts")) if name in self._table else None for name in names
                ]
                blocks.append((int(n_places), *arrays))
            index.attach(blocks, self.array("masses"), self.array("live"))
        except (KeyError, TypeError, ValueError) as error:
            raise IndexFileError(f"{self.path}: damaged place index: {error}") from error
        return index

    def verify_postings(self) -> None:
        """Verify the postings unless that was done already: about a second for each two gigabytes.

        Raises:
            IndexFileError: they are damaged.
        """
        with self._lock:
            if self._verified:
                return
            for name in self._table:
                if name.rpartition(".")[2] in _POSTINGS and name.startswith("block"):
                    self.array(name)
            self._verified = True


def save(
    path: Path,
    vocabulary_hash: str,
    inverted: InvertedIndex,
    snapshot: Snapshot,
    facts: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Write a snapshot of an inverted index with the owner's facts (JSON) and named arrays.

    Queries and additions go on meanwhile. The file replaces an older one when it is complete on disk.

    Raises:
        IndexFileError: it cannot be written.
    """
    blocks, masses, live = snapshot
    sections: dict[str, NDArray[Any]] = {**arrays, "masses": masses, "live": live}
    for number, (_, *streams) in enumerate(blocks):
        for name, stream in zip(_STREAMS, streams, strict=True):
            if stream is not None:
                sections[f"block{number}.{name}"] = stream
    index = {
        "with_signatures": inverted.with_signatures,
        "with_geometry": inverted.with_geometry,
        "block_places": inverted.block_places,
        "blocks": [n_places for n_places, *_ in blocks],
    }
    sections = {name: np.ascontiguousarray(array) for name, array in sections.items()}
    content = {"vocabulary": vocabulary_hash, "facts": dict(facts), "index": index}
    header = _header(content, sections)
    preamble = _PREAMBLE.pack(MAGIC, VERSION, len(header))
    pieces: list[Any] = [preamble, hashlib.sha256(preamble + header).digest(), header]
    for array in sections.values():
        pieces += [array.data if array.size else b"", b"\0" * (-array.nbytes % ALIGNMENT)]
    try:
        store.replace(path, *pieces)
    except VocabularyFileError as error:
        raise IndexFileError(str(error)) from error


def load(path: Path) -> IndexFile:
    """Open a place index; see the module for what is verified when.

    Raises:
        IndexFileError: the file is missing, damaged, or of an unknown version.
    """
    if path.exists() and not path.is_file():  # to open a named pipe would wait for ever
        raise IndexFileError(f"{path}: cannot read the place index: it is no file")
    try:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:  # ValueError: an empty file cannot be mapped
        raise IndexFileError(f"{path}: cannot read the place index: {error}") from error
    if len(content) < _HEADER_START or content[: len(MAGIC)] != MAGIC:
        raise IndexFileError(f"{path}: not a Seamark place index")
    _, version, length = _PREAMBLE.unpack_from(content)
    if version != VERSION:
        raise IndexFileError(f"{path}: place index of version {version}; this program reads version {VERSION}")
    raw = content[_HEADER_START : _HEADER_START + length]
    if hashlib.sha256(content[: _PREAMBLE.size] + raw).digest() != content[_PREAMBLE.size : _HEADER_START]:
        raise IndexFileError(f"{path}: damaged place index: the checksum of the header does not agree")
    try:
        header = json.loads(raw)
        end = max(entry["offset"] + _size(entry) for entry in header["sections"].values())
        opened = IndexFile(path, content, header)
    except (KeyError, TypeError, ValueError) as error:
        raise IndexFileError(f"{path}: damaged place index: {error}") from error
    if len(content) != -(-end // ALIGNMENT) * ALIGNMENT:
        raise IndexFileError(f"{path}: damaged place index: {len(content)} bytes where the header promises {end}")
    return opened


def _header(content: Mapping[str, Any], sections: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the header; offsets follow its own length, so it is written with offsets from 0 first to learn that."""
    table: dict[str, dict[str, Any]] = {}
    offset = 0
    for name, array in sections.items():
        digest = hashlib.sha256(array.data if array.size else b"").hexdigest()
        table[name] = {"dtype": array.dtype.str, "shape": list(array.shape)}
        table[name] |= {"offset": offset, "sha256": digest}
        offset += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
    room = len(json.dumps({**content, "sections": table})) + 16 * len(table) + 16
    start = -(-(_HEADER_START + room) // ALIGNMENT) * ALIGNMENT
    for entry in table.values():
        entry["offset"] += start
    return json.dumps({**content, "sections": table}, allow_nan=False).encode().ljust(start - _HEADER_START)


def _size(entry: Mapping[str, Any]) -> int:
    return int(np.prod(entry["shape"])) * np.dtype(entry["dtype"]).itemsize
