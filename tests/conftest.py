import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # many small matrices: threads only wait for each other

import numpy as np
import pytest
import warp as wp

from warp_spo.execution import plan

wp.config.log_level = wp.LOG_WARNING
sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed; behind an installed warp_spo


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device that the kernels run on")
    parser.addoption(
        "--granularity",
        default="node",
        choices=["node", "segment", "tree", "plan"],
        help="of tests that do not say; node needs no compilation for a scene, plan is what users get",
    )


def pytest_configure(config):
    asked = config.getoption("--granularity")
    plan.DEFAULT = None if asked == "plan" else asked


@pytest.fixture(scope="session")
def device(request):
    return wp.get_device(request.config.getoption("--device"))


@pytest.fixture
def rng():
    return np.random.default_rng(0)
