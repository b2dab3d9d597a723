"""Long-run studies and timings: `python -m benchmarks.closures` and its siblings."""
