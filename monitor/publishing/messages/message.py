"""Base class of all messages, and encoding of messages as JSON.

The publisher, ``watch``, ``view`` and history queries use the same message classes. The order of the fields in a class
is the order of the JSON keys. NaN is written as null, because JSON cannot represent NaN. In an array, null is read as
NaN. Unknown keys are ignored, so that messages from newer daemons remain readable.
"""

from functools import cache
from typing import Annotated, Any, ClassVar, Final, Self, TypeVar, get_args

import msgspec
import numpy as np

from monitor.common.topics import ZenohTopic

MAX_PAYLOAD_BYTES: Final = 1_000_000
"""Largest accepted payload. A typical message for six axes is a few kilobytes long."""
Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]


class Message(msgspec.Struct, frozen=True, kw_only=True, eq=False, tag_field="schema"):
    """Base class of messages about one device. The library msgspec writes and checks the key ``schema``."""

    topic: ClassVar[ZenohTopic]

    device: str = ""
    t: float | None = None
    """Unix time of the newest sample [s]. None until a device that supplies its own sample times has sent a sample."""
    samples: Count = 0
    """Number of samples of the device since the start."""

    @classmethod
    def from_result(cls, device: str, t: float | None, samples: int, result: Any) -> Self:
        """Build the message from a result of the daemon.

        Parameters
        ----------
        device
            Name of the device.
        t
            Unix time of the result [s].
        samples
            Number of samples of the device since the start. A result with an attribute ``samples`` replaces it.
        result
            Result whose attributes have the names of message fields.
        """
        head = {"device": device, "t": t, "samples": samples}
        return cls(**head | attributes_with_field_names(cls, result) | cls._convert(t, result))

    @classmethod
    def _convert(cls, _t: float | None, _result: Any) -> dict[str, Any]:
        """Return the message fields that are not attributes of the result."""
        raise NotImplementedError

    def encode(self) -> bytes:
        """Encode the message as JSON."""
        return encode_json(self)


M = TypeVar("M", bound=Message)


def decode_message(message_type: type[M], payload: bytes, max_bytes: int = MAX_PAYLOAD_BYTES) -> M:
    """Decode a message of the given class.

    Parameters
    ----------
    message_type
        Expected class of the message.
    payload
        JSON text of the message.
    max_bytes
        Largest accepted size of the payload.

    Raises
    ------
    ValueError
        If the payload is too large or does not contain a message of the given class.
    """
    if len(payload) > max_bytes:
        raise ValueError(f"the payload has {len(payload)} bytes; at most {max_bytes} are read")
    try:
        found = _decoder(message_type).decode(payload)  # msgspec reports decoding errors as ValueError
    except RecursionError as error:
        raise ValueError(str(error)) from error
    if not isinstance(found, message_type):
        raise ValueError(f'schema "{Message.__name__}" instead of {message_type.topic.schema_name()}')
    return found


def encode_json(value: Any) -> bytes:
    """Encode msgspec structs, NumPy arrays and built-in types as JSON."""
    return _ENCODER.encode(value)


def attributes_with_field_names(struct_type: type[msgspec.Struct], source: Any) -> dict[str, Any]:
    """Return the attributes of an object that have the same names as the fields of a struct.

    Parameters
    ----------
    struct_type
        Class of the msgspec struct.
    source
        Object with the attributes.
    """
    return {name: getattr(source, name) for name in _shared_names(struct_type.__struct_fields__, source.__class__)}


@cache
def _shared_names(names: tuple[str, ...], source_type: type) -> tuple[str, ...]:
    """Return the names that are also attributes of a class, or fields of a dataclass."""
    own = {*dir(source_type), *getattr(source_type, "__dataclass_fields__", ())}
    return tuple(name for name in names if name in own)


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be encoded as JSON")


def _decode_array(kind: Any, value: Any) -> Any:
    if get_args(kind)[-1] == np.dtype[np.int64]:  # the other arguments depend on the version of NumPy
        try:
            return np.array(msgspec.convert(value, list[int]), np.int64)
        except OverflowError as error:
            raise ValueError("an integer has more than 64 bits") from error
    rows = isinstance(value, list) and value and isinstance(value[0], list)
    numbers = msgspec.convert(value, list[list[float | None]] if rows else list[float | None])
    return np.array(numbers, np.float64)


@cache
def _decoder(kind: type[M]) -> "msgspec.json.Decoder[M | Message]":
    """Return a decoder for a union of classes, because msgspec requires the key ``schema`` only in unions."""
    return msgspec.json.Decoder(kind | Message, dec_hook=_decode_array)


_ENCODER: Final = msgspec.json.Encoder(enc_hook=_encode_array)
