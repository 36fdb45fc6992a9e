"""OpenSim models and muscle paths."""
