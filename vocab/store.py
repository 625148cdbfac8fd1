"""The vocabulary file.

Layout, little-endian: magic (8 bytes), version (u32), length of the header (u32), SHA-256 (32 bytes) of the 16 bytes
before it and of everything after it; the header, JSON in UTF-8 filled with blanks up to a multiple of 64 bytes from the
start of the file; the weights (n_words float32), the words (n_words x 128 uint8). The header holds ``n_words``,
``descriptor_size`` and ``provenance``.
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
VERSION = 1
ALIGNMENT = 64
_PREAMBLE = struct.Struct("<8sII")
_HEADER_START = _PREAMBLE.size + hashlib.sha256().digest_size


def write(path: Path, words: NDArray[np.uint8], idf: NDArray[np.float32], provenance: Mapping[str, Any]) -> None:
    """Write words (n, d) uint8, weights (n,) float32 and provenance atomically.

    Raises:
        VocabularyFileError: the provenance is not JSON or the file cannot be written.
    """
    description = {"n_words": len(words), "descriptor_size": words.shape[1], "provenance": dict(provenance)}
    try:
        header = json.dumps(description, sort_keys=True, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise VocabularyFileError(f"{path}: the provenance is not JSON: {error}") from error
    header = header.ljust(-(-(_HEADER_START + len(header)) // ALIGNMENT) * ALIGNMENT - _HEADER_START)
    body = b"".join((header, idf.astype("<f4").tobytes(), np.ascontiguousarray(words).tobytes()))
    preamble = _PREAMBLE.pack(MAGIC, VERSION, len(header))
    _replace(path, preamble + hashlib.sha256(preamble + body).digest() + body)


def read(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.float32], dict[str, Any]]:
    """Return words (n, d) uint8, weights (n,) float32 and provenance; both arrays are mapped to the file, read-only.

    Raises:
        VocabularyFileError: the file is missing, damaged, or of an unknown version.
    """
    try:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:  # ValueError: an empty file cannot be mapped
        raise VocabularyFileError(f"{path}: cannot read the vocabulary: {error}") from error
    header = _checked_header(path, memoryview(content))
    n_words, size = _dimensions(path, header)
    start = _HEADER_START + _PREAMBLE.unpack_from(content)[2]
    if len(content) != start + n_words * (4 + size):
        raise VocabularyFileError(f"{path}: damaged vocabulary: {len(content)} bytes do not hold {n_words} words")
    idf = np.frombuffer(content, "<f4", n_words, start)
    words = np.frombuffer(content, np.uint8, n_words * size, start + 4 * n_words).reshape(n_words, size)
    return words, idf, header["provenance"]


def _checked_header(path: Path, content: memoryview) -> dict[str, Any]:
    if len(content) < _HEADER_START or bytes(content[: len(MAGIC)]) != MAGIC:
        raise VocabularyFileError(f"{path}: not a Seamark vocabulary")
    _, version, header_length = _PREAMBLE.unpack_from(content)
    if version != VERSION:
        raise VocabularyFileError(f"{path}: vocabulary of version {version}; this program reads version {VERSION}")
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
    return header


def _dimensions(path: Path, header: dict[str, Any]) -> tuple[int, int]:
    n_words, size = header.get("n_words"), header.get("descriptor_size")
    if not isinstance(n_words, int) or not isinstance(size, int) or n_words < 1 or size < 1:
        raise VocabularyFileError(f"{path}: damaged vocabulary: {n_words} words of {size} bytes")
    return n_words, size


def _replace(path: Path, content: bytes) -> None:
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise VocabularyFileError(f"{path}: cannot write the vocabulary: {error}") from error
