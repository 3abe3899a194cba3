"""What is logged every frame, as Arrow arrays.

Rerun's own archetypes check and convert each field in Python, which costs three times as much;
here the component names are taken from those archetypes once, so that the rows are the same.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from streamtrack.types import Points

Row: TypeAlias = list[rr.DescribedComponentBatch]

_XY = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
_STRIP = pa.list_(pa.field("item", _XY, nullable=False))


class _Column:
    """An Arrow array as Rerun wants it handed over."""

    __slots__ = ("_array",)

    def __init__(self, array: pa.Array) -> None:
        self._array = array

    def as_arrow_array(self) -> pa.Array:
        return self._array


def _descriptors(archetype: rr.AsComponents) -> list[rr.ComponentDescriptor]:
    return [batch.component_descriptor() for batch in archetype.as_component_batches()]


(_SCALAR,) = _descriptors(rr.Scalars(0.0))
_POSITIONS, _POINT_CLASSES = _descriptors(
    rr.Points2D.from_fields(positions=[[0.0, 0.0]], class_ids=[0])
)
_STRIPS, _STRIP_CLASSES = _descriptors(
    rr.LineStrips2D.from_fields(strips=[[[0.0, 0.0]]], class_ids=[0])
)


def scalar(value: float) -> Row:
    """One value of a curve; NaN is a gap."""
    return [_batch(pa.array([value], pa.float64()), _SCALAR)]


def points(positions: Points, classes: npt.NDArray[np.uint16] | None = None) -> Row:
    """Points (N, 2) with their class ids (N,)."""
    row = [_batch(_xy_array(positions), _POSITIONS)]
    if classes is not None:
        row.append(_batch(pa.array(classes), _POINT_CLASSES))
    return row


def strips(corners: npt.NDArray[np.float32], classes: npt.NDArray[np.uint16] | None = None) -> Row:
    """Line strips (M, K, 2) of K points each with their class ids (M,)."""
    count, length = corners.shape[:2]
    offsets = pa.array(np.arange(count + 1, dtype=np.int32) * np.int32(length))
    array = pa.ListArray.from_arrays(offsets, _xy_array(corners), type=_STRIP)
    row = [_batch(array, _STRIPS)]
    if classes is not None:
        row.append(_batch(pa.array(classes), _STRIP_CLASSES))
    return row


def _xy_array(positions: npt.NDArray[np.float32]) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(positions, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, type=_XY)


def _batch(array: pa.Array, descriptor: rr.ComponentDescriptor) -> rr.DescribedComponentBatch:
    return rr.DescribedComponentBatch(_Column(array), descriptor)
