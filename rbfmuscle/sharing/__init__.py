"""The muscles of a run, distributed to processes where there are many."""
