"""Names of NumPy's arrays by the type of their numbers."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
