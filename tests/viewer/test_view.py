"""The command ``view``: the address it prints, and pictures without a display."""

import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from command_line import call

from rbfmuscle.display.pictures import render_run


def image(path):
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def test_picture_is_of_the_frame_asked_for(run_folder, tmp_path, capsys, graphics):
    code, out, err = call(
        capsys, "view", run_folder, "--at", "frame=2", "--screenshot", tmp_path / "x/y/a.png"
    )
    assert code == 0, err
    assert Path(out.strip()) == tmp_path / "x/y/a.png"
    for frame in (0, 2):
        render_run(run_folder, tmp_path / f"{frame}.png", frame=frame)
    asked, first, third = (image(tmp_path / f"{name}.png") for name in ("x/y/a", "0", "2"))
    np.testing.assert_array_equal(asked, third)
    assert (asked != first).any(axis=2).mean() > 0.01
    assert call(capsys, "view", run_folder, "--screenshot", tmp_path / "plain.png")[0] == 0
    np.testing.assert_array_equal(image(tmp_path / "plain.png"), first)


def test_picture_of_a_scene_is_of_the_pose_asked_for(tmp_path, capsys, graphics):
    common = ("view", "phantom", "--model", "pbd", "--screenshot")
    for name, degrees in (("rest", 0), ("bent", 10)):
        code, _, err = call(
            capsys, *common, tmp_path / f"{name}.png", "--at", f"hip.flexion={degrees}"
        )
        assert code == 0, err
    assert (image(tmp_path / "rest.png") != image(tmp_path / "bent.png")).any(axis=2).mean() > 0.01


def test_screenshot_of_a_comparison_has_its_models_side_by_side(run_folder, tmp_path, capsys):
    for name in ("rbf", "pbd"):
        shutil.copytree(run_folder, tmp_path / name)
    code, _, err = call(
        capsys, "view", tmp_path, "--at", "frame=2", "--screenshot", tmp_path / "a.png"
    )
    assert code == 0, err
    render_run(run_folder, tmp_path / "b.png", frame=2, views=["motion"])
    both, one = image(tmp_path / "a.png"), image(tmp_path / "b.png")
    wide = one.shape[1]
    assert both.shape[1] == 2 * wide
    titles = slice(0, 22)
    for half in (both[:, :wide], both[:, wide:]):  # below the titles, which name the models
        assert (half[titles] != one[titles]).any()
        np.testing.assert_array_equal(half[22:300], one[22:300])
    assert (both[titles, :wide] != both[titles, wide:]).any()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--at", "hip.flexion"], "COORDINATE=DEGREES"),
        (["--at", "hip.flexion=3"], "unknown coordinate 'hip.flexion'"),
        (["--at", "frame=7", "--screenshot", "x.png"], "was not written"),
        (["--model", "pbd"], "does not take --model"),
    ],
)
def test_wrong_use_is_one_line(run_folder, capsys, arguments, says):
    code, _, err = call(capsys, "view", run_folder, *arguments)
    assert code == 2 and says in err.splitlines()[-1]


def test_address_is_printed_and_answers_until_interrupted(run_folder):
    with subprocess.Popen(
        [sys.executable, "-m", "rbfmuscle", "view", run_folder, "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        address = process.stdout.readline().split()[0]
        with urllib.request.urlopen(address) as answer:
            assert b"<html" in answer.read()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err and out == ""
