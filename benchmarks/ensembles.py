"""Ensembles in chunks: their time compared with `vmap`, memory, and interrupted runs.

The system is the chaotic system with s = 2 and h = 0.1. The members are a function of
their index, and the ensemble computes the mean and the variance of the energy at the
end. The time per member and step is compared with one call of a compiled `vmap` of 1000
members, which is measured before and after the ensemble in the same process. Times are
processor times; the time of `vmap` is the least of all calls. Peak memory is measured
in a separate process for each number of members, and includes the memory of the
compiler.

With `--kills K`, a run of 200 chunks that writes to disk is killed (kill -9) K times at
random moments, and resumed each time. Its files are compared, byte for byte, with the
files of a run that was not interrupted. With `--processes P`, this test is repeated
with two JAX processes. In addition, the compiled ensemble is then run P times by one
process and by two processes, each with one core. The table has wall times and processor
times, each the larger value of both processes. A wall time above the processor time
shows that other programs were running.

    python -m benchmarks.ensembles --members 10000 100000 1000000 --num-steps 1000
"""

import argparse
import hashlib
import json
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems

from ._report import from_fresh_process, least_time, markdown_table, write


H, BATCH, ROUNDS, CHUNKS = 0.1, 1000, 3, 200
REDUCTIONS = {"mean": nhjax.Mean(), "variance": nhjax.Variance()}


def problem(num_steps: int) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return two functions: the run of a member, and the member of an index."""
    chaotic, method = systems.ChaoticSystem(), nhjax.LobattoIIIAB(2)

    def member(index):
        angle = (0.5 * jnp.pi / BATCH) * (index % BATCH).astype(float)
        q0 = chaotic.q0.at[0].set(jnp.cos(angle))
        return q0, chaotic.v0.at[1].set(jnp.sin(angle))

    def run(member):
        return nhjax.integrate(
            chaotic.system,
            method,
            nhjax.initial_state(chaotic.system, *member),
            dt=H,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(t1=True, fn=chaotic.system.energy),
            throw=False,
        )

    return run, member


def measure(members: int, num_steps: int, rounds: int = ROUNDS) -> dict[str, Any]:
    """Measure times per member and step of `vmap` and the ensemble, and peak memory."""
    run, member = problem(num_steps)

    def chunks(count):
        return nhjax.ensemble(
            run, member, num_members=count, chunk_size=BATCH, reduce=REDUCTIONS
        )

    bare = jax.jit(jax.vmap(lambda index: run(member(index))))
    indices = jnp.arange(BATCH)
    jax.block_until_ready(bare(indices))
    # A second chunk compiles the program that merges states.
    chunks(2 * BATCH)
    one = least_time(partial(bare, indices), rounds, time.process_time) / BATCH
    start, before = time.perf_counter(), time.process_time()
    outcome = chunks(members)
    many = (time.process_time() - before) / members
    seconds = time.perf_counter() - start
    # `vmap` is measured before and after the ensemble, so that other load on the
    # machine affects both.
    after = least_time(partial(bare, indices), rounds, time.process_time) / BATCH
    one = min(one, after)
    return {
        "members": members,
        "num_steps": num_steps,
        "bare": 1e6 * one / num_steps,
        "ensemble": 1e6 * many / num_steps,
        "ratio": many / one,
        "seconds": seconds,
        "failed": len(outcome.failed),
        "mean": float(outcome.statistics["mean"].ys[0]),
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def stream(folder: str) -> None:
    """Run an ensemble of many chunks that are written to disk."""
    run, member = problem(50)
    nhjax.ensemble(run, member, num_members=CHUNKS * 64, chunk_size=64, out=folder)


def digest(folder: Path) -> str:
    """Compute a checksum of all files of a store and of their names."""
    made = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            made.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return made.hexdigest()


def start(count: int, *arguments: str, first_core: int = 0) -> list[subprocess.Popen]:
    """Start this program in `count` processes that form one JAX job.

    Each process has one core and one thread.
    """
    with socket.socket() as found:
        found.bind(("localhost", 0))
        port = found.getsockname()[1]
    cores = sorted(os.sched_getaffinity(0))
    started = []
    for index in range(count):
        core = str(cores[(first_core + index) % len(cores)])
        parts = [str(index), str(count), str(port), core]
        command = [sys.executable, "-m", "benchmarks.ensembles", *arguments]
        started.append(
            subprocess.Popen(
                [*command, "--process", *parts],
                env=os.environ | {"NPROC": "1"},
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        )
    return started


def join(index: int, count: int, port: int, core: int) -> None:
    """Make this process one of the processes of a job, on one core."""
    os.sched_setaffinity(0, {core})
    if count > 1:
        jax.distributed.initialize(f"localhost:{port}", count, index)


def ended(processes: list[subprocess.Popen]) -> list[str]:
    """Wait for processes, and return what they have printed."""
    found = [process.communicate()[0] for process in processes]
    if any(process.returncode for process in processes):
        raise RuntimeError("A process has failed.")
    return found


def timed(members: int) -> list[float]:
    """Return the wall time and the processor time of the second run of an ensemble.

    The first run compiles.
    """
    run, member = problem(1000)
    found = []
    for _ in range(2):
        start = time.perf_counter(), time.process_time()
        nhjax.ensemble(
            run, member, num_members=members, chunk_size=BATCH, reduce=REDUCTIONS
        )
        found = [time.perf_counter() - start[0], time.process_time() - start[1]]
    return found


def speedup(rounds: int, members: int = 200_000) -> dict[str, Any]:
    """Measure one process and two processes in turn, `rounds` times."""
    found: dict[str, list[list[float]]] = {"one": [], "two": []}
    for i in range(rounds):
        for name, count in (("one", 1), ("two", 2)):
            texts = ended(start(count, "--timed", str(members), first_core=i))
            times = [json.loads(text.splitlines()[-1]) for text in texts]
            found[name].append([max(x) for x in zip(*times, strict=True)])
    return found | {"members": members}


def kills(number: int, count: int = 1, seed: int = 0) -> dict[str, Any]:
    """Kill a run at random moments between its first chunk and its last."""
    moments, reached = random.Random(seed), []
    with tempfile.TemporaryDirectory() as scratch:
        whole, killed = Path(scratch, "whole"), Path(scratch, "killed")
        ended(start(1, "--stream", str(whole)))

        def done():
            parts = (killed / "manifest").glob("chunks*.jsonl")
            return sum(part.read_bytes().count(b"\n") for part in parts)

        for _ in range(number):
            processes = start(count, "--stream", str(killed))
            before = done()
            # Kill before the last chunk, so that chunks are left for the next kills.
            goal = before + moments.uniform(0, 2 * (CHUNKS - before) / (number + 1))
            while processes[0].poll() is None and done() < goal:
                time.sleep(0.0005)
            # Kill the processes in random order, with some time between them.
            for process in moments.sample(processes, count):
                time.sleep(moments.uniform(0, 0.02))
                process.send_signal(signal.SIGKILL)
            for process in processes:
                process.communicate()
            reached.append(done())
        ended(start(count, "--stream", str(killed)))
        return {
            "kills": number,
            "processes": count,
            "chunks_done": reached,
            "is_same": digest(whole) == digest(killed),
        }


def table(rows: list[dict[str, Any]]) -> str:
    """Write the table of times and memory."""
    header = ["members", "steps", "bare vmap [µs]", "ensemble [µs]", "ratio"]
    header += ["wall [s]", "failed", "peak memory [MB]"]
    lines = [
        [
            str(x["members"]),
            str(x["num_steps"]),
            f"{x['bare']:.4f}",
            f"{x['ensemble']:.4f}",
            f"{x['ratio']:.3f}",
            f"{x['seconds']:.1f}",
            str(x["failed"]),
            f"{x['megabytes']:.0f}",
        ]
        for x in rows
    ]
    return markdown_table(header, lines)


def told(found: dict[str, Any]) -> str:
    """Write in words whether killed runs gave the same files."""
    same = "the same" if found["is_same"] else "OTHER"
    who = "One process" if found["processes"] == 1 else "Two processes"
    return (
        f"\n\n{who} killed {found['kills']} times, with "
        f"{', '.join(map(str, found['chunks_done']))} of {CHUNKS} chunks done: "
        f"{same} bytes as undisturbed."
    )


def compared(found: dict[str, Any]) -> str:
    """Write the table of times of one process and of two processes."""
    lines = [
        [f"{x:.2f}" for x in (*one, *two, two[0] / one[0], two[1] / one[1])]
        for one, two in zip(found["one"], found["two"], strict=True)
    ]
    header = ["one: wall [s]", "processor [s]", "two: wall [s]", "processor [s]"]
    return (
        f"\n\n{found['members']} members of 1000 steps by one process and by two, "
        "with a core and a thread each, in turn:\n\n"
        + markdown_table([*header, "ratio of walls", "of processors"], lines)
    )


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=[10_000, 30_000])
    parser.add_argument("--num-steps", type=int, default=100)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--processes", type=int, default=0, metavar="P")
    parser.add_argument("--stream", help="only write such a store")
    parser.add_argument("--timed", type=int, help="only time so many members")
    parser.add_argument("--one", type=int, help="only measure so many members")
    parser.add_argument("--process", type=int, nargs=4, help="be one of several")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.process is not None:
        join(*options.process)
    if options.stream is not None:
        stream(options.stream)
        return
    if options.timed is not None:
        print(json.dumps(timed(options.timed)))
        return
    if options.one is not None:
        print(json.dumps(measure(options.one, options.num_steps)))
        return
    rows = []
    for members in options.members:
        of_one = "--one", str(members), "--num-steps", str(options.num_steps)
        rows.append(from_fresh_process("ensembles", *of_one))
        print(rows[-1], flush=True)
    text = "Time of a member and step, and peak memory.\n\n" + table(rows)
    data: dict[str, Any] = {"rows": rows}
    if options.kills:
        data["killed"] = [kills(options.kills)]
        if options.processes:
            data["killed"].append(kills(options.kills, count=2))
        text += "".join(map(told, data["killed"]))
    if options.processes:
        data["processes"] = speedup(options.processes)
        text += compared(data["processes"])
    write("ensembles", "Ensembles in chunks", text, data)


if __name__ == "__main__":
    main()
