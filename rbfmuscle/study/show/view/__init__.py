"""The window: what it shows of a live scene or a saved run, and its switches."""
