"""References that only benchmarks and tests use."""
