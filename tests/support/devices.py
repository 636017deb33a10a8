"""Devices on which kernels are tested: the CPU, and a GPU where there is one."""

import pytest
import warp as wp

DEVICES = [
    "cpu",
    pytest.param(
        "cuda:0",
        marks=[
            pytest.mark.gpu,
            pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device"),
        ],
    ),
]
