"""Commands that read from and write for OpenSim."""
