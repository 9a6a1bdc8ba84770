"""Plain values and arrays as bytes that cannot contain code: JSON and safetensors.

A state is None, booleans, numbers, strings, numpy arrays and scalars, in any nesting of dicts (with
strings or integers as keys), lists and tuples. `state.json` has the nesting, the names and the
plain values; `state.safetensors` has the arrays. Reading gives equal values of equal types, and
writing them again gives equal bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save as save_safetensors

from music_rllib.limits import check_safetensors, open_regular

TREE, ARRAYS = "state.json", "state.safetensors"


class StateError(ValueError):
    """The files contain no state; the message names them."""


def canonical_json(value: Any) -> str:
    """JSON that is the same for equal values: sorted keys, no spaces, shortest floats.

    Raises:
        ValueError: `value` contains NaN or infinity.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def content_key(value: Any) -> str:
    """The first 80 bits of the SHA-256 of `value`'s canonical JSON, in hex."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:20]


def arrays_to_bytes(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Named arrays as the content of a safetensors file."""
    # In C order, because safetensors writes the memory as it is and ignores strides.
    return save_safetensors({key: np.asarray(a, order="C") for key, a in arrays.items()})


def arrays_from_bytes(data: bytes) -> dict[str, npt.NDArray[Any]]:
    """Inverse of `arrays_to_bytes`.

    Raises:
        ValueError: The data is not the content of a safetensors file.
    """
    try:
        check_safetensors(data)
        return load_safetensors(data)
    except (safetensors.SafetensorError, KeyError, TypeError) as error:
        raise ValueError(str(error)) from error


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write named arrays as a safetensors file.

    Raises:
        OSError: The file cannot be written.
    """
    path.write_bytes(arrays_to_bytes(arrays))


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Inverse of `write_arrays`.

    Raises:
        StateError: The file does not exist or is not a safetensors file.
    """
    try:
        with open_regular(path) as file:
            return arrays_from_bytes(file.read())
    except (OSError, ValueError) as error:
        raise StateError(f"{path} must be a safetensors file: {error}") from error


def write_state(folder: Path, state: Any) -> None:
    """Write `state` into an existing folder.

    Raises:
        TypeError: The state contains something else; the message names the place.
        OSError: The folder cannot be written.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    tree = _encode(state, "state", arrays)
    write_arrays(folder / ARRAYS, arrays)
    (folder / TREE).write_text(json.dumps(tree, separators=(",", ":")), encoding="utf-8")


def read_state(folder: Path) -> Any:
    """Inverse of `write_state`.

    Raises:
        StateError: The folder contains no state.
    """
    arrays = read_arrays(folder / ARRAYS)
    try:
        with open_regular(folder / TREE) as file:
            return _decode(json.loads(file.read()), arrays)
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise StateError(f"{folder / TREE} must be a saved state: {error}") from error


def _encode(value: Any, place: str, arrays: dict[str, npt.NDArray[Any]]) -> Any:
    """`value` as JSON: a plain value unchanged, others as a list that begins with their kind."""
    if isinstance(value, np.ndarray | np.generic):  # first, because np.float64 is a float
        kind = "array" if isinstance(value, np.ndarray) else "scalar"
        if value.dtype.kind not in "biuf":
            raise TypeError(f"{place} must be numbers to be saved, got {value.dtype}")
        name = str(len(arrays))
        arrays[name] = np.asarray(value)
        return [kind, name]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str | int):
                raise TypeError(f"{place} must have strings or integers as keys, got {key!r}")
        pairs = [[key, _encode(inner, f"{place}.{key}", arrays)] for key, inner in value.items()]
        return ["dict", *pairs]
    if isinstance(value, list | tuple):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return [kind, *(_encode(inner, f"{place}[{i}]", arrays) for i, inner in enumerate(value))]
    raise TypeError(f"{place} must be a plain value to be saved, got {type(value).__name__}")


def _decode(tree: Any, arrays: Mapping[str, npt.NDArray[Any]]) -> Any:
    if not isinstance(tree, list):
        return tree
    kind, *content = tree
    match kind:
        case "array":
            return arrays[content[0]]
        case "scalar":
            return arrays[content[0]][()]
        case "dict":
            return {key: _decode(inner, arrays) for key, inner in content}
        case "list":
            return [_decode(inner, arrays) for inner in content]
        case "tuple":
            return tuple(_decode(inner, arrays) for inner in content)
    raise ValueError(f"unknown kind {kind!r}")
