"""``rbfmuscle cache``: what is kept on disk."""

from __future__ import annotations

from cyclopts import App

cache_app = App(name="cache", help="Bone distance fields and weights of mesh muscles, kept on disk.")


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


@cache_app.command
def clear() -> None:
    """Remove all entries of the cache."""
    from rbfmuscle.sim.cache import cache_clear

    count, size = cache_clear()
    print(f"{count} entries removed, {size / 1e6:.1f} MB")
