"""Long-run studies and timings: run one as `python -m benchmarks.closures`."""
