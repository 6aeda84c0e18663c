# SPDX-License-Identifier: Apache-2.0
"""Mutated logs and bags: each must be read, or refused in one line, quickly and in little memory.

The whole command runs on each in this process, to make exceptions visible. The same seed gives the
same files.
"""

import contextlib
import io
import multiprocessing
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import bench
import numpy as np

sys.path[:0] = [str(bench.ROOT / "test"), str(bench.ROOT / "test" / "import_logs")]

from blackbox_writing import blackbox  # noqa: E402
from excerpts import rewritten  # noqa: E402
from good_logs import COLUMNS, TABLE, plane_log, ulog  # noqa: E402
from hostile import mutated  # noqa: E402
from mcap.writer import CompressionType  # noqa: E402

from uav_ident_ros.bags.reading import Bag, BagError  # noqa: E402
from uav_ident_ros.identification.settings import SettingsError  # noqa: E402
from uav_ident_ros.import_logs.cli import main as import_log  # noqa: E402
from uav_ident_ros.offline.inputs import choose_inputs  # noqa: E402
from uav_ident_ros.offline.run import OfflineRun  # noqa: E402

LONGEST, MOST_MEMORY = 10.0, 500.0
"""Limits for reading one file: processor time, s, and memory of the process, MiB."""

ADDRESSES = 2 * 2**30
"""Address space of a process, bytes: a file that needs more fails, and the machine does not."""

HUNG = 300
"""Time after which the reader counts as hung, s, even on a busy machine."""

SECONDS = 3.0


class Outcome(NamedTuple):
    """Result of one file, such as refused or FAILED; time (s); peak memory (MiB); output."""

    result: str
    seconds: float
    memory: float
    printed: str


# --- whole files ----------------------------------------------------------------------------------


def write_whole(folder: Path) -> dict[str, Path]:
    """Write one good file of each kind, of a few seconds."""
    share = SECONDS / 10.0  # relative to the tests' flights
    files = {"ulg": ulog(folder, share), "bin": plane_log(folder, share=share)}
    files["csv"] = folder / "whole.csv"
    files["csv"].write_text(TABLE)
    files["bbl"] = folder / "whole.bbl"
    files["bbl"].write_bytes(blackbox())
    for compression in CompressionType:
        name = f"mcap {compression.name.lower()}"
        path = folder / f"{name}.mcap"
        files[name] = rewritten(path, compression=compression, seconds=SECONDS)
    return files


# --- reading --------------------------------------------------------------------------------------


def read_log(path: Path) -> tuple[str, str]:
    """Import a log; return the result and the printed text.

    A refusal must print one line and leave no output: this is asserted.
    """
    folder = path.with_suffix(".out")
    columns = path.with_suffix(".yaml")
    columns.write_text(COLUMNS)
    options = ["--columns", str(columns)] if path.suffix == ".csv" else []
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = import_log([str(path), "--output", str(folder), *options])
    printed = err.getvalue()
    assert status in (0, 1, 2), status
    assert (status == 2) == (len(printed.splitlines()) == 1) == (not folder.exists()), printed
    assert status == 2 or not printed, printed
    if status != 2:
        with Bag(folder) as bag:
            assert not bag.damage, bag.damage
    return ("whole", "with a loss", "refused")[status], printed


def read_bag(path: Path) -> tuple[str, str]:
    """Run the identifier over a bag; return the result and the printed text."""
    try:
        with Bag(path) as bag:
            offline = OfflineRun(choose_inputs(bag, {}))
            offline.run(bag)
            return ("with a loss" if bag.damage else "whole"), "; ".join(bag.damage)
    except (BagError, SettingsError) as error:
        first, *_ = str(error).splitlines()
        assert first, "an empty message"
        return "refused", str(error)


def judge(
    job: tuple[str, str, int, str],  # Kind, original file, seed, folder for the mutated ones
) -> Outcome:
    """Mutate a file, read it, and return the result."""
    kind, whole, seed, folder = job
    content = mutated(Path(whole).read_bytes(), np.random.default_rng([seed, len(kind)]))
    path = Path(folder) / f"{kind.replace(' ', '_')}_{seed}.{kind.split()[0]}"
    path.write_bytes(content)
    read = read_bag if kind.startswith("mcap") else read_log
    begin = time.process_time()
    try:
        result, printed = read(path)
    except BaseException:
        result, printed = "FAILED", f"{path.name}: {traceback.format_exc()}"
    seconds = time.process_time() - begin
    for file in (path, path.with_suffix(".yaml")):
        file.unlink(missing_ok=True)
    shutil.rmtree(path.with_suffix(".out"), ignore_errors=True)
    return Outcome(result, seconds, bench.peak_mb(), printed)


def judge_in_time(job: tuple[str, str, int, str]) -> Outcome:
    """Judge a file; a file that takes too long has failed."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _too_long)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    signal.alarm(HUNG)
    try:
        return judge(job)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.alarm(0)


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {LONGEST} s")


def main() -> int:
    """Mutate and read files; return 1 if one was neither read nor refused properly, else 0."""
    parser = bench.parser(__doc__, workers=2)
    parser.add_argument("--count", type=int, default=5000, help="files of each kind (5000)")
    parser.add_argument("--only", default="", help="kinds that begin like this")
    options = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        files = write_whole(Path(name))
        with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
            for kind, whole in files.items():
                if not kind.startswith(options.only):
                    continue
                jobs = [(kind, str(whole), seed, name) for seed in range(options.count)]
                outcomes = pool.map(judge_in_time, jobs, chunksize=20)
                failed |= report(kind, outcomes)
    return int(failed)


def report(kind: str, outcomes: list[Outcome]) -> bool:
    """Print the results of the files of one kind; return whether any failed."""
    results = Counter(outcome.result for outcome in outcomes)
    counts = ", ".join(f"{count} {result}" for result, count in sorted(results.items()))
    slowest = max(outcome.seconds for outcome in outcomes)
    memory = max(outcome.memory for outcome in outcomes)
    print(f"{kind:10} {counts}; slowest {slowest:.1f} s, at most {memory:.0f} MiB", flush=True)
    for outcome in [o for o in outcomes if o.result == "FAILED"][:5]:
        print(outcome.printed)
    return results["FAILED"] > 0 or memory > MOST_MEMORY


if __name__ == "__main__":
    sys.exit(main())
