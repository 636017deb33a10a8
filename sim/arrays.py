"""Types that all of the simulator shares."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Called with the fraction of the work that is done, 0 to 1.
Progress = Callable[[float], None]
