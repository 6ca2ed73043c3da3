"""The processes that runs are run in: what reaches them, what they inherit, and that scripts need no guard."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from commands import COMMAND, ENVIRONMENT, compared_here, rows, search, small, summary, write_config, write_plugin
from timing import PATIENCE

from omnibench.compare.config import CompareConfig, read_compare_config
from omnibench.compare.plan import load_datasets
from omnibench.compare.run import run_comparison
from omnibench.data.storage import save_dataset
from omnibench.progress import Progress

# Looks through all that can be reached from the problem, from every frame and from every module, for arrays that hold
# given bytes and for texts that hold a given word.
SPY = """
import gc
from pathlib import Path

NEEDLES = {needles!r}
WORD = {word!r}

@calibrators.register("spy")
class Spy(Calibrator):
    "Looks for data that it should not see."

    def calibrate(self, problem):
        found = set()
        frame, frames = sys._getframe(), []
        while frame is not None:
            frames.append(dict(frame.f_locals))
            frame = frame.f_back
        waiting, seen = [problem, list(sys.modules.values()), frames], {{id(NEEDLES), id(globals())}}
        while waiting:
            item = waiting.pop()
            if id(item) in seen:
                continue
            seen.add(id(item))
            if isinstance(item, np.ndarray):
                content = np.ndarray.tobytes(item)
                found |= {{name for name, needle in NEEDLES.items() if bytes.fromhex(needle) in content}}
            elif isinstance(item, (str, Path)) and item is not WORD and WORD in str(item):
                found.add(f"a text about {{WORD}}: {{item}}")
            else:
                waiting.extend(gc.get_referents(item))
        return Solution(problem.start, f"looked at {{len(seen)}}, found {{', '.join(sorted(found))}}")
"""


def test_validation_data_are_out_of_a_calibrators_reach(tmp_path: Path) -> None:
    dataset = load_datasets(read_compare_config(write_config(tmp_path)))["flower"]
    save_dataset(dataset, tmp_path / "hideaway")
    needles = {
        f"{kind} {split}": array.tobytes().hex()
        for split in ("train", "validation")
        for kind, array in (
            ("rates", dataset.split(split)[2].rates[:4]),
            ("poses", dataset.split(split)[2].poses[1:4]),
        )
    }
    plugins = write_plugin(tmp_path / "plugins", "spy", SPY.format(needles=needles, word="hide" + "away"))
    config = {
        "datasets": {"flower": {"path": str(tmp_path / "hideaway")}},
        "plugins": [str(plugins)],
        "calibrators": ["spy"],
    }
    compared_here(tmp_path / "out", **config)
    row = rows(tmp_path / "out")["spy"]
    assert row["outcome"] == "converged", row["reason"]
    looked_at, found = row["reason"].removeprefix("looked at ").split(", found ")
    assert int(looked_at) > 50_000
    assert found == "poses train, rates train"


@pytest.mark.slow
def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\nimport omnibench\nprint('once')\n"
        f"config = omnibench.read_compare_config(Path({str(write_config(tmp_path))!r}))\n"
        f"result = omnibench.run_comparison(config, Path({str(tmp_path / 'out')!r}))\n"
        "print(sorted(run.record.outcome for run in result.runs))\n"
    )
    run = subprocess.run(
        [COMMAND[0], str(script)], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert run.stderr == ""
    assert run.stdout.splitlines()[0] == "once"
    assert run.stdout.count("once") == 1
    assert [run["outcome"] for run in summary(tmp_path / "out")["runs"]] == ["converged", "converged", "budget"]


def test_a_comparison_runs_in_another_thread_than_the_main_one_and_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    def state() -> tuple[Any, ...]:
        threads = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        return threads, signal.getsignal(signal.SIGINT), sys.modules["__main__"], multiprocessing.active_children()

    before = state()
    thread = threading.Thread(target=compared_here, args=(tmp_path / "out",))
    thread.start()
    thread.join(timeout=PATIENCE)
    assert [run["outcome"] for run in summary(tmp_path / "out")["runs"]] == ["converged", "converged", "budget"]
    assert state() == before


@pytest.mark.parametrize("workers", [1, 2])
def test_no_more_runs_are_under_way_than_there_are_workers(workers: int, tmp_path: Path) -> None:
    class Count:
        most = 0

        def __init__(self) -> None:
            self.now: set[str] = set()

        def __call__(self, event: Progress) -> None:
            if event.unit == "evaluation":
                (self.now.discard if event.over else self.now.add)(event.task)
                self.most = max(self.most, len(self.now))

    count = Count()
    entries = [search(str(number), 300 + number) for number in range(4)]
    config = CompareConfig.model_validate(small(calibrators=entries, workers=workers))
    run_comparison(config, tmp_path / "out", count)
    assert (count.most, count.now) == (workers, set())


def test_progress_tells_evaluations_and_the_best_cost(tmp_path: Path) -> None:
    events: list[Progress] = []
    entries = [search(candidates=20_000, batch=20)]
    config = CompareConfig.model_validate(small(calibrators=entries, budget={"evaluations": 20_000}))
    result = run_comparison(config, tmp_path / "out", events.append)
    counts, bests = zip(
        *((event.done, event.best) for event in events if event.best is not None and not event.over), strict=True
    )
    assert list(counts) == sorted(counts)
    assert list(bests) == sorted(bests, reverse=True)
    assert bests[-1] >= (result.runs[0].record.train_cost or 0.0) - 1e-11  # the verdict is by direct integration
