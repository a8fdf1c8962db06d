"""A study on a Dask cluster: one task for each part, and one table at the end.

    dask scheduler                                      # on one machine
    dask worker tcp://HOST:8786 --nworkers 2 --nthreads 1     # on each machine
    python dask_sweep.py tcp://HOST:8786 8 out/study \
        paper --vary design.epsilon=100:10000:log9 --seeds 20

The arguments are the scheduler, the number of parts, the output folder, which all workers share, and
what `host-sim sweep` is to run. The same line again continues after an interruption. HOST_SIM names
the program, if it is not on the search path.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from distributed import Client, as_completed, get_worker


def run_part(program, options, folder, number, parts):
    """Runs one part; returns its table and the worker that ran it."""
    shard = f"{number}/{parts}"
    command = [program, "sweep", *options, "--out", str(folder), "--shard", shard, "--threads", "1"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"part {shard}: {done.stderr.strip()}")
    digits = len(str(parts))
    return folder / f"shard-{number:0{digits}}" / "results.csv", get_worker().address


def main():
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    scheduler, parts, folder, *options = sys.argv[1:]
    parts, folder = int(parts), Path(folder).absolute()
    program = os.environ.get("HOST_SIM", "host-sim")
    with Client(scheduler) as client:
        tasks = [
            client.submit(run_part, program, options, folder, number, parts, pure=False)
            for number in range(1, parts + 1)
        ]
        for count, task in enumerate(as_completed(tasks), 1):
            _, worker = task.result()
            print(f"{count} of {parts} parts, this one on {worker}", flush=True)
        tables = [task.result()[0] for task in tasks]
    with open(folder / "results.csv", "wb") as merged:
        for table in tables:
            with open(table, "rb") as part:
                shutil.copyfileobj(part, merged)
    subprocess.run([program, "sweep", "--summarise", str(folder / "results.csv")], check=True)


if __name__ == "__main__":
    main()
