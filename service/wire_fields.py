"""How one field of a message travels: numbers, words, arrays, nested messages, and each of them optional."""

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

DTYPES = {
    name: np.dtype(name).newbyteorder("<") for name in ("uint8", "uint16", "int32", "int64", "float32", "float64")
}
MAX_DIMENSIONS = 4


class MalformedFieldError(ValueError):
    """A field has a value that it cannot have; :mod:`seamark.service.wire` makes a WireError of it."""


class Field(Protocol):
    """Moves one value into a field of a Protobuf message and back; both raise ValueError for impossible values."""

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field ``name`` of the message."""
        ...

    def get(self, message: Any, name: str) -> Any:
        """Return the value of the field ``name`` of the message."""
        ...


class Packer(Protocol):
    """What :class:`seamark.service.wire.Schema` can do."""

    def pack(self, value: object) -> Any:
        """Return the Protobuf message of a value."""
        ...

    def unpack(self, message: Any) -> Any:
        """Return the value of a Protobuf message."""
        ...


class _Scalar:
    kind: type = object

    def put(self, message: Any, name: str, value: Any) -> None:
        setattr(message, name, self.kind(value))

    def get(self, message: Any, name: str) -> Any:
        return getattr(message, name)


class Integer(_Scalar):
    """A whole number."""

    kind = int


class Number(_Scalar):
    """A float64, NaN and infinities included."""

    kind = float


class Flag(_Scalar):
    """True or false."""

    kind = bool


class Blob(_Scalar):
    """Bytes."""

    kind = bytes


class Text(_Scalar):
    """A string; what is not Unicode (file names may be anything) is replaced by question marks."""

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        setattr(message, name, str(value).encode("utf-8", "replace").decode("utf-8"))


class Word:
    """A member of an enumeration, as its value."""

    def __init__(self, words: type[StrEnum]) -> None:
        self._words = words

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        setattr(message, name, self._words(value).value)

    def get(self, message: Any, name: str) -> StrEnum:
        """Return the member."""
        return self._words(getattr(message, name))


class Numbers:
    """A short tuple of floats."""

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        getattr(message, name).extend(float(number) for number in value)

    def get(self, message: Any, name: str) -> tuple[float, ...]:
        """Return the floats."""
        return tuple(getattr(message, name))


class Optional:
    """A field that may be None, which travels as absence."""

    def __init__(self, field: Field) -> None:
        self._field = field

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field unless the value is None."""
        if value is not None:
            self._field.put(message, name, value)

    def get(self, message: Any, name: str) -> Any:
        """Return the value or None."""
        return self._field.get(message, name) if message.HasField(name) else None


class Array:
    """A numpy array of one of the given dtypes and shapes (None: any length), read-only when it arrives."""

    def __init__(self, dtypes: tuple[str, ...], *shapes: tuple[int | None, ...]) -> None:
        self._dtypes = dtypes
        self._shapes = shapes

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        self.pack(getattr(message, name), np.asarray(value))

    def get(self, message: Any, name: str) -> np.ndarray[Any, Any]:
        """Return the array."""
        if not message.HasField(name):
            raise MalformedFieldError("missing")
        return self.unpack(getattr(message, name))

    def pack(self, packed: Any, array: np.ndarray[Any, Any]) -> None:
        """Fill an Array message."""
        self._check(array.dtype.name, array.shape)
        packed.data = np.ascontiguousarray(array, DTYPES[array.dtype.name]).tobytes()
        packed.shape.extend(array.shape)
        packed.dtype = array.dtype.name

    def unpack(self, packed: Any) -> np.ndarray[Any, Any]:
        """Return the array of an Array message."""
        shape, data = tuple(packed.shape), packed.data
        self._check(packed.dtype, shape)
        dtype = DTYPES[packed.dtype]
        if math.prod(shape) * dtype.itemsize != len(data):
            raise MalformedFieldError(f"{len(data)} bytes cannot be {packed.dtype} of shape {shape}")
        if data:
            return np.frombuffer(data, dtype).reshape(shape)
        empty = np.zeros(shape, dtype)
        empty.setflags(write=False)
        return empty

    def _check(self, dtype: str, shape: tuple[int, ...]) -> None:
        if dtype not in self._dtypes:
            raise MalformedFieldError(f"dtype {dtype[:20]!r}; possible is {' or '.join(self._dtypes)}")
        if len(shape) > MAX_DIMENSIONS or not any(self._fits(shape, wanted) for wanted in self._shapes):
            raise MalformedFieldError(f"shape {shape[:8]}; possible is {' or '.join(map(str, self._shapes))}")

    @staticmethod
    def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
        return len(shape) == len(wanted) and all(
            want is None or want == have for want, have in zip(wanted, shape, strict=True)
        )


class Picture:
    """An image: an array, or the bytes of a JPEG or PNG file."""

    def __init__(self, array: Array) -> None:
        self._array = array

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        picture = getattr(message, name)
        if isinstance(value, bytes):
            picture.encoded = value
        else:
            self._array.pack(picture.raw, np.asarray(value))

    def get(self, message: Any, name: str) -> Any:
        """Return the array or the bytes."""
        picture = getattr(message, name)
        content = picture.WhichOneof("content")
        if content is None:
            raise MalformedFieldError("missing")
        return self._array.unpack(picture.raw) if content == "raw" else picture.encoded


class Nested:
    """A message inside the message."""

    def __init__(self, schema: Packer) -> None:
        self._schema = schema

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        getattr(message, name).CopyFrom(self._schema.pack(value))

    def get(self, message: Any, name: str) -> Any:
        """Return the inner value."""
        if not message.HasField(name):
            raise MalformedFieldError("missing")
        return self._schema.unpack(getattr(message, name))


class Repeated:
    """A tuple of messages."""

    def __init__(self, schema: Packer) -> None:
        self._schema = schema

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set the field."""
        getattr(message, name).extend([self._schema.pack(item) for item in value])

    def get(self, message: Any, name: str) -> tuple[Any, ...]:
        """Return the tuple."""
        return tuple(self._schema.unpack(item) for item in getattr(message, name))


class Map:
    """A dictionary from names to numbers, in order, as messages with ``name`` and one more attribute.

    ``number`` says whether the values are floats (True), integers (False) or lists of floats (None).
    """

    def __init__(self, attribute: str, *, number: bool | None) -> None:
        self._attribute = attribute
        self._number = number

    def put(self, message: Any, name: str, value: Mapping[str, Any]) -> None:
        """Set the field."""
        for key, content in value.items():
            entry = getattr(message, name).add(name=key)
            if self._number is False:
                setattr(entry, self._attribute, int(content))
            else:
                getattr(entry, self._attribute).extend([float(content)] if self._number else map(float, content))

    def get(self, message: Any, name: str) -> dict[str, Any]:
        """Return the dictionary."""
        entries = {entry.name: getattr(entry, self._attribute) for entry in getattr(message, name)}
        if self._number is False:
            return entries
        if self._number is None:
            return {key: list(values) for key, values in entries.items()}
        if any(len(values) != 1 for values in entries.values()):
            raise MalformedFieldError("one number per name is expected")
        return {key: values[0] for key, values in entries.items()}
