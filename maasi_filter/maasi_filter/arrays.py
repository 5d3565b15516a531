"""Types of arrays."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainValidator

# pydantic accepts them unchecked in records that are read from a file.
_AS_IT_IS = PlainValidator(lambda value: value)

FloatArray = Annotated[NDArray[np.float64], _AS_IT_IS]
IntArray = Annotated[NDArray[np.int64], _AS_IT_IS]
BoolArray = Annotated[NDArray[np.bool_], _AS_IT_IS]
ByteArray = Annotated[NDArray[np.uint8], _AS_IT_IS]
ImageArray = ByteArray
