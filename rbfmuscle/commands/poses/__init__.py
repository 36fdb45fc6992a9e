"""Commands that ask where muscles rest in a pose."""
