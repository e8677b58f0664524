"""Checkpoints of a training: all that it goes on from, as plain arrays in one file.

The file is written whole, so a process that is killed leaves the checkpoint before.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from countersteer.errors import InputError
from countersteer.writing import write_whole


def save(path: Path, about: Mapping[str, Any], state: Any, curves: list[dict[str, float]]) -> None:
    """Write a checkpoint. `about` tells what must be the same for the training to go on."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    told = {"about": dict(about), "curves": curves}
    arrays: dict[str, Any] = {f"leaf_{i}": leaf for i, leaf in enumerate(leaves)}
    buffer = io.BytesIO()
    np.savez(buffer, told=np.frombuffer(json.dumps(told).encode(), np.uint8), **arrays)
    write_whole(path, buffer.getvalue())


def load(
    path: Path, about: Mapping[str, Any], like: Any
) -> tuple[Any, list[dict[str, float]]] | None:
    """The state and the curves of a checkpoint; None without a file.

    `like` is a state of the same form. Raises `InputError` if the checkpoint is of another
    training, or is none.
    """
    if not path.exists():
        return None
    shapes, structure = jax.tree.flatten(like)
    try:
        with np.load(path) as file:
            told = json.loads(file["told"].tobytes().decode())
            leaves = [file[f"leaf_{i}"] for i in range(len(shapes))]
        theirs, curves = told["about"], told["curves"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: is no checkpoint: remove it to begin anew") from None
    mine = json.loads(json.dumps(dict(about)))
    for key in sorted({*mine, *theirs}):
        if mine.get(key) != theirs.get(key):
            raise InputError(
                f"{path}: is of a training with {key} {theirs.get(key)!r}, not {mine.get(key)!r}: "
                "give what it had, or another --out, or remove it to begin anew"
            )
    for leaf, shape in zip(leaves, shapes, strict=True):
        if leaf.shape != shape.shape or leaf.dtype != shape.dtype:
            raise InputError(f"{path}: is of another version: remove it to begin anew")
    return jax.tree.unflatten(structure, leaves), curves
