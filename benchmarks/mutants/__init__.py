"""Planted faults: a seeded sample over every room, each run against the tests that its line is known to reach."""
