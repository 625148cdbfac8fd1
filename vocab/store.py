"""The vocabulary file.

Layout, little-endian: magic (8 bytes), version (u32), length of the header (u32), SHA-256 (32 bytes) of the 16 bytes
before it and of everything after it; the header, JSON in UTF-8 filled with blanks up to a multiple of 64 bytes from the
start of the file; then the arrays. The header holds ``provenance`` and ``sections``: for each array, by name, ``dtype``
(as numpy writes it, ``<f4``), ``shape`` and ``offset`` from the start of the file, a multiple of 64. ``words`` and
``idf`` are always there; readers keep sections that they do not know.

Version 1, which is read but no longer written, has ``n_words`` and ``descriptor_size`` instead of sections: the weights
(n_words float32) follow the header, and the words (n_words x 128 uint8) the weights.
"""

import hashlib
import json
import mmap
import os
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import VocabularyFileError

MAGIC = b"SMVOCAB\0"
VERSION = 2
READABLE = (1, 2)
ALIGNMENT = 64
_PREAMBLE = struct.Struct("<8sII")
_HEADER_START = _PREAMBLE.size + hashlib.sha256().digest_size
_PLACEHOLDER = 10**15  # as wide as any offset will be, so that offsets do not change the length of the header

Sections = Mapping[str, NDArray[Any]]


def write(path: Path, sections: Sections, provenance: Mapping[str, Any]) -> None:
    """Write named arrays and the provenance atomically.

    Raises:
        VocabularyFileError: the provenance is not JSON or the file cannot be written.
    """
    arrays = {name: np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for name, array in sections.items()}
    try:
        start = _HEADER_START + len(_header(arrays, dict.fromkeys(arrays, _PLACEHOLDER), provenance))
        start = _aligned(start)
        offsets, end = {}, start
        for name, array in arrays.items():
            offsets[name] = end
            end = _aligned(end + array.nbytes)
        header = _header(arrays, offsets, provenance).ljust(start - _HEADER_START)
    except (TypeError, ValueError) as error:
        raise VocabularyFileError(f"{path}: the provenance is not JSON: {error}") from error
    pieces = [header, *(array.tobytes().ljust(_aligned(array.nbytes), b"\0") for array in arrays.values())]
    body = b"".join(pieces)
    preamble = _PREAMBLE.pack(MAGIC, VERSION, len(header))
    replace(path, preamble, hashlib.sha256(preamble + body).digest(), body)


def read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the named arrays, mapped to the file and read-only, and the provenance.

    Raises:
        VocabularyFileError: the file is missing, damaged, or of an unknown version.
    """
    if path.exists() and not path.is_file():  # to open a named pipe would wait for ever
        raise VocabularyFileError(f"{path}: cannot read the vocabulary: it is no file")
    try:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:  # ValueError: an empty file cannot be mapped
        raise VocabularyFileError(f"{path}: cannot read the vocabulary: {error}") from error
    version, header = _checked_header(path, memoryview(content))
    table = header.get("sections")
    try:
        if version == 1:
            table = _sections_of_version_1(header, _HEADER_START + _PREAMBLE.unpack_from(content)[2], len(content))
        sections = {str(name): _array(content, entry) for name, entry in dict(table or {}).items()}
        if not {"words", "idf"} <= sections.keys():
            raise ValueError("the words or their weights are missing")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise VocabularyFileError(f"{path}: damaged vocabulary: {error}") from error
    return sections, header["provenance"]


def replace(path: Path, *pieces: Any) -> None:
    """Write a file from bytes-like pieces; an older one stays until the new one is complete on disk.

    Raises:
        VocabularyFileError: the file cannot be written.
    """
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                for piece in pieces:
                    file.write(piece)
                file.flush()
                os.fsync(file.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise VocabularyFileError(f"{path}: cannot write the file: {error}") from error


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def _header(arrays: Sections, offsets: Mapping[str, int], provenance: Mapping[str, Any]) -> bytes:
    sections = {
        name: {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offsets[name]}
        for name, array in arrays.items()
    }
    return json.dumps({"provenance": dict(provenance), "sections": sections}, sort_keys=True, allow_nan=False).encode()


def _checked_header(path: Path, content: memoryview) -> tuple[int, dict[str, Any]]:
    if len(content) < _HEADER_START or bytes(content[: len(MAGIC)]) != MAGIC:
        raise VocabularyFileError(f"{path}: not a Seamark vocabulary")
    _, version, header_length = _PREAMBLE.unpack_from(content)
    if version not in READABLE:
        raise VocabularyFileError(f"{path}: vocabulary of version {version}; this program reads up to {VERSION}")
    digest = hashlib.sha256(content[: _PREAMBLE.size])
    digest.update(content[_HEADER_START:])
    if digest.digest() != content[_PREAMBLE.size : _HEADER_START]:
        raise VocabularyFileError(f"{path}: damaged vocabulary: the checksum does not agree with the content")
    try:
        header = json.loads(bytes(content[_HEADER_START : _HEADER_START + header_length]))
    except ValueError as error:
        raise VocabularyFileError(f"{path}: damaged vocabulary: the header is not JSON") from error
    if not isinstance(header, dict) or not isinstance(header.get("provenance"), dict):
        raise VocabularyFileError(f"{path}: damaged vocabulary: the header is incomplete")
    return version, header


def _sections_of_version_1(header: Mapping[str, Any], start: int, size: int) -> dict[str, Any]:
    n, width = int(header["n_words"]), int(header["descriptor_size"])
    if n < 1 or size != start + n * (4 + width):
        raise ValueError(f"{size} bytes do not hold {n} words")
    return {
        "idf": {"dtype": "<f4", "shape": [n], "offset": start},
        "words": {"dtype": "|u1", "shape": [n, width], "offset": start + 4 * n},
    }


def _array(content: mmap.mmap, entry: Mapping[str, Any]) -> NDArray[Any]:
    kind, shape, offset = np.dtype(entry["dtype"]), [int(size) for size in entry["shape"]], int(entry["offset"])
    if kind.hasobject or min(shape, default=0) < 0 or offset < _HEADER_START:
        raise ValueError(f"an array cannot be {entry}")
    return np.frombuffer(content, kind, int(np.prod(shape)), offset).reshape(shape)
