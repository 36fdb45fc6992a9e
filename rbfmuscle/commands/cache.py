"""``rbfmuscle cache``: what is kept on disk."""

from __future__ import annotations

from typing import Annotated

from cyclopts import App, Parameter

cache_app = App(
    name="cache", help="Bone distance fields, weights of mesh muscles and compiled loops, kept on disk."
)


@cache_app.command
def path() -> None:
    """Print the folder of the cache."""
    from rbfmuscle.sim.cache import cache_path

    print(cache_path())


@cache_app.command(name="list")
def list_entries() -> None:
    """Print the entries of the cache and their sizes."""
    from rbfmuscle.sim.cache import cache_list

    for entry in cache_list():
        print(f"{entry['name']}  {entry['bytes'] / 1e6:.1f} MB")


@cache_app.command(name="compile")
def compile_loops(*tasks: str) -> None:
    """Compile what commands and models need, ahead of the first run.

    Parameters
    ----------
    tasks
        Models (rbf, pbd ...) and commands (kernels, plan ...); all by default.
    """
    from rbfmuscle.compiled.store import folders
    from rbfmuscle.compiled.warm import warm_up

    count = warm_up(*tasks)
    print(f"{count} loops compiled" + (f", kept in {folders()[0]}" if folders() else ""))


@cache_app.command
def clear(*, loops: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Remove all entries of the cache.

    Parameters
    ----------
    loops
        Remove the compiled loops instead.
    """
    from rbfmuscle.compiled.store import clear_entries
    from rbfmuscle.sim.cache import cache_clear

    count, size = clear_entries() if loops else cache_clear()
    print(f"{count} {'loops' if loops else 'entries'} removed, {size / 1e6:.1f} MB")
