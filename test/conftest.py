# SPDX-License-Identifier: Apache-2.0
"""Setup of all tests: BLAS threads, signals, Hypothesis profiles, separate ROS domains."""

import fcntl
import gc
import os
import signal
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import pytest
import yaml
from hypothesis import settings

# The package limits BLAS's threads by the environment, so it must load before NumPy.
import uav_ident_ros  # noqa: F401
from uav_ident_ros.process import own_domain

# A shell starts background processes with SIGINT ignored, and every child inherits that:
# the programs under test could not be interrupted.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # `nohup`: a handler is not inherited
    signal.signal(signal.SIGHUP, lambda *_: None)

# Every run draws the same examples on any machine. New examples, ten times as many:
# scripts/test --hypothesis-profile anew
settings.register_profile(
    "repeatable", max_examples=50, derandomize=True, deadline=None, database=None
)
settings.register_profile("anew", max_examples=500, deadline=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Spread the tests of nodes and of the report over the workers, early in each share.

    They mostly wait, or follow one another in one browser. Each worker starts with its own share of
    the list; pure computation remains for the end.
    """
    workers = getattr(config, "workerinput", {}).get("workercount", 1)
    files = [list(own) for _, own in groupby(items, key=lambda item: item.path)]
    waiting = [own for own in files if own[0].path.parent.name in ("node", "report")]
    others = [item for own in files if own not in waiting for item in own]
    ordered: list[pytest.Item] = []
    for k in range(workers):
        own = others[len(others) * k // workers : len(others) * (k + 1) // workers]
        nodes = waiting[k::workers]
        every = max(1, 3 * len(own) // (4 * max(1, len(nodes))))
        for place, tests in enumerate(nodes):
            ordered += [*tests, *own[place * every : (place + 1) * every]]
        ordered += own[len(nodes) * every :]
    items[:] = ordered


def pytest_collection_finish() -> None:
    """Exclude modules and collected tests from garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def ros_environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Isolate the DDS traffic, logs and saved files of this process and its children."""
    environment = {
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
        "ROS_HOME": str(tmp_path_factory.mktemp("ros_home")),
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
    }
    with own_domain(), pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(scope="session")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the parameter file of a flight that starts a tenth below its true coefficients.

    It has a verdict after three seconds, not after half a minute, and still has to learn. The start
    is `start.yaml` beside the file.
    """
    import numpy as np
    from equations import matrix
    from excerpts import BAGS, parameter_file, parameters

    from uav_ident_ros.files.coefficients_file import save_coefficients
    from uav_ident_ros.identification.estimate import CoefficientSet
    from uav_ident_ros.identification.structure import STRUCTURES

    folder = tmp_path_factory.mktemp("warm")
    truth = yaml.safe_load((BAGS / "multisine" / "truth.yaml").read_text())["coefficients"]
    structure = STRUCTURES[parameters()["structure"]]
    start = 0.9 * matrix(structure, truth)
    sigma = np.where(structure.mask, 0.2 + 0.15 * np.abs(start), 0.0)
    save_coefficients(CoefficientSet(structure.name, start, sigma), folder / "start.yaml")
    values = parameters(initial_coefficients_file=str(folder / "start.yaml"))
    return parameter_file(folder / "identifier.yaml", **values)


@pytest.fixture(scope="session")
def replayed_example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a replay, with report, of the JSBSim aircraft's committed bag.

    The first worker of the run that needs them creates them for all workers.
    """
    from excerpts import BAGS, replay

    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    made, done = root / "replays" / "c172p", root / "replays.done"
    with (root / "replays.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            assert replay(BAGS / "c172p", made, "--report", by="c172p") == 0
            done.touch()
    return made
