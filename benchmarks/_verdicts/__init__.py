"""The claims of the paper's sections 5 and 7; `benchmarks.verdicts` measures all."""
