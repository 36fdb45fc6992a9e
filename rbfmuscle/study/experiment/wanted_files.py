"""What `reach_error` found, as a line, as lines to paste and as a file."""

from __future__ import annotations

from pathlib import Path

from rbfmuscle.study.experiment.wanted_error import WantedError
from rbfmuscle.study.files.writer import json_text


def describe_wanted(name: str, found: WantedError, units: str = "") -> str:
    """One line: what reaches the wanted error, or what the best reached.

    Parameters
    ----------
    name : str
        Of the surface.
    found : WantedError
    units : str
    """
    unit, kind = f" {units}" if units else "", "greatest" if found.greatest else "RMS"
    row = found.row
    said = f"{row['kernel']} with {row['centres']} centres"
    if found.reached:
        return (
            f"{name}: {said} reaches {found.error:.3g}{unit} {kind} on unseen points, wanted {found.wanted:g} "
            f"(condition {row['condition']:.1e}, fit {1e3 * row['fit_time']:.3g} ms)"
        )
    if row["unfit"]:
        return f"{name}: no field is fit; take more centres or another kernel"
    return (
        f"{name}: {found.wanted:g}{unit} {kind} is not reached; the best, {said}, reaches {found.error:.3g}; "
        "allow more centres (--most), other kernels, or a larger error"
    )


def write_wanted(results: dict[str, WantedError], directory: str | Path, *, units: str = "") -> None:
    """Write ``error.json``: for each surface what was found and all that was tried.

    Parameters
    ----------
    results : dict of str to WantedError
    directory : path
    units : str
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    facts = {
        name: {"reached": r.reached, "error": r.error, "wanted": r.wanted, "greatest": r.greatest, "units": units,
               "row": r.row, "toml": r.toml(), "tried": r.tried}
        for name, r in results.items()
    }  # fmt: skip
    (directory / "error.json").write_text(json_text(facts), encoding="utf-8")
