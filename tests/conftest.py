import gc
import os
import socket
import sys
from pathlib import Path
from unittest import mock

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # many small matrices: threads only wait for each other

import numpy as np
import pytest
import warp as wp
from slow_cases import SLOW_CASES

from warp_spo.execution import plan
from warp_spo.kernels import native

wp.config.log_level = wp.LOG_WARNING
sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed; behind an installed warp_spo


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device that the kernels run on")
    parser.addoption(
        "--granularity",
        default="plan",
        choices=["node", "segment", "tree", "plan"],
        help="of Dynamics whose tests name none; plan is what users get",
    )
    parser.addoption(
        "--optimized",
        action="store_true",
        help="compile straight-line kernels for the CPU as users do: to the same bits, in three times the time",
    )


def pytest_configure(config):
    gc.set_threshold(50_000, 10, 50)  # of the many small objects of traces; by default a quarter of the time goes there
    if config.getoption("--device") == "cpu":
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    asked = config.getoption("--granularity")
    plan.DEFAULT = None if asked == "plan" else asked
    if not config.getoption("--optimized"):
        native.kernel = without_optimization(native.kernel)


def pytest_collection_modifyitems(items):
    for item in items:
        if item.nodeid.rpartition("/")[2] in SLOW_CASES:
            item.add_marker(pytest.mark.slow)


def without_optimization(make):
    """Return ``make`` with kernels that the CPU's compiler does not optimize; a GPU's compiler does.

    Most of the time of a run without a kernel cache would go into optimizing straight-line kernels. The compiler may
    not fuse their products and sums, so that results keep their bits. Kernels at node granularity, whose functions are
    fused when they are inlined, are compiled as users compile them.
    """

    def make_unoptimized(*arguments, **options):
        kernel = make(*arguments, **options)
        if not wp.is_cuda_available():
            kernel.module.options["optimization_level"] = 0
        return kernel

    return make_unoptimized


def pytest_collection_finish(session):
    """On the CPU Newton's kernels, which are no part of what is tested, are compiled without optimization.

    Those of its kinematics alone would take nine seconds.
    """
    if not wp.is_cuda_available() and not session.config.getoption("--optimized"):
        for name, module in list(sys.modules.items()):
            if name.startswith("newton."):
                wp.set_module_options({"optimization_level": 0}, module)


@pytest.fixture(scope="session")
def device(request):
    return wp.get_device(request.config.getoption("--device"))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def offline():
    """A connection is an error: no robot file makes one."""
    with mock.patch.object(socket.socket, "connect", side_effect=AssertionError("a robot file opened a connection")):
        yield
