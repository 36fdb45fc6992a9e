"""The muscles of a run, dealt out to processes where they are many."""
