"""How many processes a run's muscles are worth."""

from __future__ import annotations

from rbfmuscle.scene.scene import Scene

# A process more takes about two seconds to begin: fewer muscles, or fewer muscles times frames, are quicker in one.
LEAST_MUSCLES, LEAST_WORK = 5, 400
MOST_HELPERS = 4


def helpers_for(scene: Scene, threads: int) -> int:
    """How many processes should share the muscles of a run; fewer than two: none but one's own.

    Muscles that slide on each other see each other at every sub-step, and stay together.

    Parameters
    ----------
    scene : Scene
    threads : int
        That the run may use.
    """
    count = len(scene.muscles)
    if scene.sliding is not None or count * len(scene.motion.frames) < LEAST_WORK:
        return 0
    return min(threads, count // LEAST_MUSCLES, MOST_HELPERS)
