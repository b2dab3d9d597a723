"""Ensembles in chunks beside a bare `vmap`, their memory, and runs that are killed.

The chaotic system, s = 2, h = 0.1, with the mean and the variance of the energy at the
end over members that are a function of their index. Beside the time of a member and
step is that of one call of a compiled `vmap` of 1000 members, in turn in one process;
times are of the processor, the least of all rounds. Peak memory is that of a process of
its own for each number of members, and grows with the compiler's before it runs.

With `--kills K` a run of 200 chunks that streams to disk is killed (kill -9) K times at
random moments, and gone on with; its bytes are compared with those of a run that
nothing has disturbed.

    python -m benchmarks.ensembles --members 10000 100000 1000000 --num-steps 1000
"""

import argparse
import hashlib
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems

from ._report import markdown_table, write


H, BATCH, ROUNDS, CHUNKS = 0.1, 1000, 3, 200
REDUCTIONS = {"mean": nhjax.Mean(), "variance": nhjax.Variance()}


def problem(num_steps: int) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """The run of a member, and the member of an index."""
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


def fastest(function: Callable[[], Any], rounds: int) -> float:
    """Seconds of the processor, the least of some rounds."""
    times = []
    for _ in range(rounds):
        start = time.process_time()
        jax.block_until_ready(function())
        times.append(time.process_time() - start)
    return min(times)


def measure(members: int, num_steps: int, rounds: int = ROUNDS) -> dict[str, Any]:
    """Time of a member and step both ways, and peak memory of this process."""
    run, member = problem(num_steps)

    def chunks(count):
        return nhjax.ensemble(
            run, member, num_members=count, chunk_size=BATCH, reduce=REDUCTIONS
        )

    bare = jax.jit(jax.vmap(lambda index: run(member(index))))
    indices = jnp.arange(BATCH)
    jax.block_until_ready(bare(indices))
    chunks(BATCH)
    one = fastest(lambda: bare(indices), rounds) / BATCH
    start, outcomes = time.perf_counter(), []
    many = fastest(lambda: outcomes.append(chunks(members)), 1) / members
    seconds = time.perf_counter() - start
    # Before and after, so that what else runs hits both.
    one = min(one, fastest(lambda: bare(indices), rounds) / BATCH)
    return {
        "members": members,
        "num_steps": num_steps,
        "bare": 1e6 * one / num_steps,
        "ensemble": 1e6 * many / num_steps,
        "ratio": many / one,
        "seconds": seconds,
        "failed": len(outcomes[0].failed),
        "mean": float(outcomes[0].statistics["mean"].ys[0]),
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def stream(folder: str) -> None:
    """A run of many chunks to disk."""
    run, member = problem(50)
    nhjax.ensemble(run, member, num_members=CHUNKS * 64, chunk_size=64, out=folder)


def digest(folder: Path) -> str:
    """A checksum of all files of a store, and of their names."""
    made = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            made.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return made.hexdigest()


def kills(number: int, seed: int = 0) -> dict[str, Any]:
    """Kill a run at random moments between its first chunk and its last."""
    moments, reached = random.Random(seed), []
    command = [sys.executable, "-m", "benchmarks.ensembles", "--stream"]
    with tempfile.TemporaryDirectory() as scratch:
        whole, killed = Path(scratch, "whole"), Path(scratch, "killed")
        subprocess.run([*command, str(whole)], check=True)
        journal = killed / "manifest" / "chunks.jsonl"

        def done():
            return journal.read_bytes().count(b"\n") if journal.exists() else 0

        for _ in range(number):
            process = subprocess.Popen([*command, str(killed)])
            before = done()
            # On the way to the end, so that there is something left for all others.
            goal = before + moments.uniform(0, 2 * (CHUNKS - before) / (number + 1))
            while process.poll() is None and done() < goal:
                time.sleep(0.0005)
            time.sleep(moments.uniform(0, 0.02))
            process.send_signal(signal.SIGKILL)
            process.wait()
            reached.append(done())
        subprocess.run([*command, str(killed)], check=True)
        return {
            "kills": number,
            "chunks_done": reached,
            "is_same": digest(whole) == digest(killed),
        }


def table(rows: list[dict[str, Any]]) -> str:
    """The times and the memory."""
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


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=[10_000, 30_000])
    parser.add_argument("--num-steps", type=int, default=100)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--stream", help="only write such a store")
    parser.add_argument("--one", type=int, help="only measure so many members")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.stream is not None:
        stream(options.stream)
        return
    if options.one is not None:
        print(json.dumps(measure(options.one, options.num_steps)))
        return
    rows = []
    for members in options.members:
        command = [sys.executable, "-m", "benchmarks.ensembles", "--one", str(members)]
        command += ["--num-steps", str(options.num_steps)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    text = "Time of a member and step, and peak memory.\n\n" + table(rows)
    data: dict[str, Any] = {"rows": rows}
    if options.kills:
        data["killed"] = found = kills(options.kills)
        same = "the same" if found["is_same"] else "OTHER"
        text += (
            f"\n\nKilled {found['kills']} times, with "
            f"{', '.join(map(str, found['chunks_done']))} of {CHUNKS} chunks done: "
            f"{same} bytes as undisturbed."
        )
    write("ensembles", "Ensembles in chunks", text, data)


if __name__ == "__main__":
    main()
