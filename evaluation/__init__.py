"""The paper's tables and the benchmarks, each one command."""
