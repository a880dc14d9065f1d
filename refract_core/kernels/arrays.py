"""How records and kernels say what their arrays are: type of the elements and number of axes.

To a type checker they are numpy's arrays of that type. To `declared` the number of axes, which numpy's own annotations
do not say, is part of a kernel's signature.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Axes(NamedTuple):
    """Number of axes of an array."""

    axes: int


BOOL_1D = Annotated[NDArray[np.bool_], Axes(1)]
U8_1D = Annotated[NDArray[np.uint8], Axes(1)]
U8_2D = Annotated[NDArray[np.uint8], Axes(2)]
U8_3D = Annotated[NDArray[np.uint8], Axes(3)]
I16_1D = Annotated[NDArray[np.int16], Axes(1)]
I16_2D = Annotated[NDArray[np.int16], Axes(2)]
I32_1D = Annotated[NDArray[np.int32], Axes(1)]
I32_2D = Annotated[NDArray[np.int32], Axes(2)]
I32_3D = Annotated[NDArray[np.int32], Axes(3)]
U32_2D = Annotated[NDArray[np.uint32], Axes(2)]
I64_1D = Annotated[NDArray[np.int64], Axes(1)]
I64_2D = Annotated[NDArray[np.int64], Axes(2)]
I64_3D = Annotated[NDArray[np.int64], Axes(3)]
F32_1D = Annotated[NDArray[np.float32], Axes(1)]
F32_2D = Annotated[NDArray[np.float32], Axes(2)]
F32_3D = Annotated[NDArray[np.float32], Axes(3)]
F64_1D = Annotated[NDArray[np.float64], Axes(1)]
F64_2D = Annotated[NDArray[np.float64], Axes(2)]
F64_3D = Annotated[NDArray[np.float64], Axes(3)]
