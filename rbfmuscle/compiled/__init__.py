"""Compiled loops: how one is declared, what names its cache, where that lies, and what compiles ahead."""
