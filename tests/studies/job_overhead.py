"""What a job costs beyond its own time, on every backend, and the bytes that it sends.

    python tests/studies/job_overhead.py [--jobs 10000] [--workers 2] [--backend processes --backend dask]

A job keeps a processor busy for --milliseconds (default 10). Overhead: wall time a job, less the jobs' own time divided
by the workers. Some file systems take a millisecond to make a file in a large /tmp: TMPDIR chooses another folder.
"""

from __future__ import annotations

import argparse
import os
import pickle
import tempfile
import time
from pathlib import Path

from busy_jobs import Done, busy

from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Job, JobWatch, ResultStore, run_jobs
from omnibench.jobs.job_process import Packer


def main() -> None:
    """Print a line for each backend."""
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # so that processes share busy_jobs, as an installed module
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=10_000)
    parser.add_argument("--milliseconds", type=float, default=10.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--backend", action="append", default=[], help="default: processes and dask")
    arguments = parser.parse_args()
    seconds = arguments.milliseconds / 1000
    jobs = [Job(f"job-{number}", busy, (number, seconds)) for number in range(arguments.jobs)]
    content = Packer().pack(jobs[0]).content
    print(f"{os.cpu_count()} processors; a job's function and argument: {len(content)} bytes, pickled whole "
          f"{len(pickle.dumps(jobs[0]))}")  # fmt: skip
    for name in arguments.backend or ("processes", "dask"):
        choice = BackendChoice(name=name, workers=arguments.workers)
        with tempfile.TemporaryDirectory() as folder, open_backend(choice, ("busy_jobs",)) as backend:
            store = ResultStore(Path(folder), Done)
            run_jobs(jobs[: 2 * arguments.workers], ResultStore(Path(folder, "first"), Done), backend, JobWatch())
            began, spent = time.perf_counter(), time.process_time()
            run_jobs(jobs, store, backend, JobWatch())
            wall, client = time.perf_counter() - began, time.process_time() - spent
            assert all(store.get(job.key) == Done(number) for number, job in enumerate(jobs))
        each = 1000 * wall / len(jobs)
        print(f"{name}: {wall:.1f} s, {each:.2f} ms a job, overhead {each - 1000 * seconds / arguments.workers:.2f} ms "
              f"(of this process {1000 * client / len(jobs):.2f} ms)", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
