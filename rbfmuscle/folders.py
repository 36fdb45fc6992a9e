"""Folders that commands write to: what they wrote is listed there, and nothing else is touched."""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from rbfmuscle.validation import UsageError

LIST = "files.txt"


class OutputFolder:
    """A folder that a command writes to: a new one, an empty one, or one with its earlier result.

    ``files.txt`` in it names the command and the files that it wrote. These alone are ever
    replaced or removed. UsageError if something else is in the way; the folder is then as it was.

    Parameters
    ----------
    directory : path
        Made when the first file is written.
    command : str
        Whose result the folder holds, for instance "run".
    names : iterable of str
        Files that the command will write, relative to the folder, and folders of such files.
    beside : bool
        Whether the files stand beside those of the user.
    replace : bool
        Whether files that are listed may be replaced.
    forced : iterable of str
        Files that the user wants replaced, whoever wrote them.
    """

    def __init__(
        self,
        directory: str | Path,
        command: str,
        names: Iterable[str] = (),
        *,
        beside: bool = False,
        replace: bool = True,
        forced: Iterable[str] = (),
    ) -> None:
        self.directory, self.command = Path(directory), command
        found = read_list(directory, command)
        self.listed = found or []
        self._ours = {*(self.listed if replace else ()), *forced}
        # Names that begin with a full stop are of files that systems leave, or that a command is
        # writing.
        there = sorted(os.listdir(directory)) if found is None and self.directory.is_dir() else []
        there = [
            name for name in there if not name.startswith(".") and (not beside or name == LIST)
        ]
        if there:
            raise UsageError(
                f"{self.directory} holds {there[0]}, and no earlier result of 'rbfmuscle "
                f"{self.command}'; give a new or an empty folder"
            )
        self.check(names)
        # Write to it, or where it would be made, before what takes time is begun.
        path = self.directory.absolute()
        place = next(place for place in (path, *path.parents) if place.exists())
        try:
            with tempfile.TemporaryFile(dir=place):
                pass
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None

    def check(self, names: Iterable[str]) -> None:
        """Raise UsageError if files or folders of these names are there that may not be
        replaced.
        """
        for name in names:
            path = self._in_the_way(name)
            if path is None:
                continue
            if path.relative_to(self.directory).as_posix() in self.listed:
                raise UsageError(
                    f"{path} exists; choose another place, or replace what is there by force"
                )
            raise UsageError(
                f"{path} is in the way: 'rbfmuscle {self.command}' has not written it; move it, "
                "or give another folder"
            )

    def clear(self) -> None:
        """Remove the earlier result, and begin a new list."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for name in self.listed:
            (self.directory / name).unlink(missing_ok=True)
        self.listed = []
        self._ours = set()
        self._write_list()

    def add(self, *names: str) -> None:
        """List files that are written next, and make their folders."""
        fresh = [name for name in dict.fromkeys(names) if name not in self._ours]
        if not fresh:
            return
        self.check(fresh)
        for folder in {(self.directory / name).parent for name in fresh}:
            folder.mkdir(parents=True, exist_ok=True)
        if not (self.directory / LIST).exists():
            self._write_list()
        with (self.directory / LIST).open("a", encoding="utf-8", newline="\n") as file:
            file.writelines(f"{name}\n" for name in fresh)
        self.listed += fresh
        self._ours.update(fresh)

    @contextmanager
    def staged(self, *, replaces: Collection[str] | None = None) -> Iterator[Path]:
        """Context of a temporary folder inside this one, whose files then take their places here.

        Each is renamed, so that a file is the earlier or the new one, whole. After an error nothing
        has changed. The earlier result goes; of it what is in folders named by ``replaces``, where
        these are given, and what is replaced.
        """
        made = not self.directory.exists()
        self.directory.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".rbfmuscle-", dir=self.directory))
        try:
            yield stage
            files = [path for path in sorted(stage.rglob("*")) if path.is_file()]
            names = [path.relative_to(stage).as_posix() for path in files]
            self.check(names)
            others = [name for name in self.listed if name not in set(names)]
            self.listed = [*others, *names]
            self._write_list()
            for name in names:
                (self.directory / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(stage / name, self.directory / name)
            for name in others:
                if replaces is None or PurePosixPath(name).parts[0] in replaces:
                    (self.directory / name).unlink(missing_ok=True)
                    self.listed.remove(name)
            self._write_list()
        finally:
            shutil.rmtree(stage, ignore_errors=True)
            if made:
                with suppress(OSError):  # it is not empty
                    self.directory.rmdir()

    def _in_the_way(self, name: str) -> Path | None:
        """What may not be replaced at a name, or in the folder of that name; None where nothing
        is.
        """
        path = self.directory / name
        if path.is_symlink() or not path.is_dir():
            return path if os.path.lexists(path) and name not in self._ours else None
        for inner in path.rglob("*"):
            folder = inner.is_dir() and not inner.is_symlink()
            known = inner.relative_to(self.directory).as_posix() in self._ours
            if not folder and not known and not inner.name.startswith("."):
                return inner
        return None

    def _write_list(self) -> None:
        lines = [_head(self.command), *self.listed]
        write_whole(self.directory / LIST, "".join(f"{line}\n" for line in lines))


def read_list(directory: str | Path, command: str) -> list[str] | None:
    """Names of the files that a command wrote to a folder; None where it has left no list.

    A list that somebody else has changed leads nowhere else: names that are not inside of the
    folder, or are behind a link, are left out.
    """
    folder = Path(directory)
    try:
        lines = (folder / LIST).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    if not lines or lines[0] != _head(command):
        return None
    return [name for name in dict.fromkeys(lines[1:]) if name and _is_inside(folder, name)]


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file in one move, so that whoever reads it finds the earlier file or the new one,
    never half of it.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    data = content.encode() if isinstance(content, str) else content
    try:
        part.write_bytes(data)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _head(command: str) -> str:
    return f"# Written by 'rbfmuscle {command}', which may replace these files and no others."


def _is_inside(folder: Path, name: str) -> bool:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or {"\\", ":"} & set(name):
        return False
    parent = (folder / name).parent
    return parent == folder or parent.resolve() == folder.resolve() / path.parent


def copy_listed(source: Path, target: Path, command: str) -> None:
    """Copy the files that a command wrote to a folder, and nothing else that lies there."""
    names = read_list(source, command)
    if names is None:
        raise UsageError(
            f"{source} has no {LIST}, which names the files of 'rbfmuscle {command}'; run it again"
        )
    for name in names:
        if (source / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source / name, target / name)
