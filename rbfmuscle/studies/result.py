"""What a study returns: its table, the folder of its files, and its page."""

import shutil
import tempfile
import weakref
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar, Self

from rbfmuscle.folders import OutputFolder, copy_listed

OnProgress = Callable[[int, int], None]  # of what is done and the total


class Study:
    """What a study found. Its files are in the folder that the caller gave; where none was given
    they go when what was returned is not used any more.

    The ``table()`` of each kind of study gives its rows as a structured ndarray, which
    ``pandas.DataFrame`` takes as it is.
    """

    command: ClassVar[str]
    page: ClassVar[str]
    _folder: Path

    def save(self, directory: str | Path) -> None:
        """Write what the command of the study writes, its page among it.

        UsageError if the folder cannot be written to, or holds anything but an earlier result.
        """
        target = OutputFolder(directory, self.command)
        if Path(directory).resolve() != self._folder.resolve():
            with target.staged() as stage:
                copy_listed(self._folder, stage, self.command)

    def show(self) -> Path:
        """Open the page of the study in a browser, and return its file."""
        page = (self._folder / self.page).resolve()
        webbrowser.open(page.as_uri())
        return page

    def kept_in(self, folder: Path, *, own: bool) -> Self:
        """The study with the folder of its files, which is removed with it where it is its
        ``own``.
        """
        self._folder = folder
        if own:
            weakref.finalize(self, shutil.rmtree, folder.parent, ignore_errors=True)
        return self


@contextmanager
def study_folder(directory: str | Path | None) -> Iterator[Path]:
    """Context with a folder, or where none is given with a new one, which is removed after an
    error.
    """
    if directory is not None:
        yield Path(directory)
        return
    made = Path(tempfile.mkdtemp(prefix="rbfmuscle-"))
    try:
        yield made / "results"
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def part_progress(progress: OnProgress | None, before: int, total: int) -> OnProgress | None:
    """Progress of a part as that of the whole: of so many that are done before, and in total."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)
