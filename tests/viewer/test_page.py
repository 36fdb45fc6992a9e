"""The page in a real browser, and the address of its server."""

import shutil
import socket
import sys
from unittest.mock import Mock
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import Browser, wait_for

import rbfmuscle as rm
from rbfmuscle.viewer.page import ViewerPage
from rbfmuscle.viewer.sources import LiveSource

FRAME, FLEXION = 0, 1  # sliders in their order
STEADY = "?fixedDpr=1"  # otherwise the page lowers its resolution where drawing is slow
SLOW = 120  # A busy machine may take this long [s].


@pytest.fixture(scope="module")
def page():
    scene = rm.phantom_scene(end=8.0, step=2.0, spacing=6.0)
    made = ViewerPage(LiveSource(scene, "pbd"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def chromium():
    if shutil.which("chromium") is None:
        pytest.skip("no chromium to open the page in")
    made = Browser()
    yield made
    made.close()


@pytest.fixture(scope="module")
def opened(page, chromium):
    made = chromium.open(page.address + STEADY)
    wait_for(lambda: "extensor" in made.text() and made.slider(FLEXION), SLOW)
    yield made
    made.close()


@pytest.fixture
def tab(page, opened):
    """The page's tab, which is at rest before and after."""
    yield opened
    page.panel.play.value = False
    page._touch(rest=True)
    wait_for(lambda: page.panel.controls["hip.flexion"].value == 0 and arrived(page), SLOW)


def arrived(page):
    figure = page.sides[0].figure
    return figure is not None and not figure.pending and not page._resting


def drag(page, tab, share):
    """Drag the slider of flexion; the number that it comes to."""
    tab.drag(FLEXION, share)
    # -30 to 30 degrees; the handle is as wide as 2 degrees.
    wait_for(lambda: abs(tab.slider(FLEXION)[0] - (60 * share - 30)) < 3, SLOW)
    # The last number that the page shows has reached the server.
    control = page.panel.controls["hip.flexion"]
    wait_for(lambda: abs(control.value - tab.slider(FLEXION)[0]) < 1e-6, SLOW)
    return tab.slider(FLEXION)[0]


def canvas(tab):
    """The picture left of the controls, once it stands still."""
    shown = [tab.picture()]

    def still():
        shown.append(tab.picture())
        return np.array_equal(shown[-1], shown[-2])

    wait_for(still, SLOW)
    return shown[-1][:, :400].astype(int)


def changed(one, two):
    """Share of the pixels that differ visibly."""
    return float((np.abs(one - two).max(axis=2) > 8).mean())


def degrees(page, side=0):
    return float(np.degrees(page.sides[side].figure.here["hip.flexion"]))


def test_page_shows_bones_muscles_and_numbers(tab):
    picture = canvas(tab)
    assert 0.03 < (picture.min(axis=2) < 200).mean() < 0.6  # neither empty nor filled
    text = tab.text()
    assert "in bones [mm]" in text and "ms per picture" in text and "flexion [°]" in text


def test_dragging_a_slider_moves_number_muscles_and_picture_and_a_reload_keeps_the_pose(page, tab):
    before = canvas(tab)
    value = drag(page, tab, 0.9)
    assert 21 < value < 27
    wait_for(lambda: abs(degrees(page) - value) < 1e-6, SLOW)
    assert changed(before, canvas(tab)) > 0.01
    tab.call("Page.reload")
    wait_for(lambda: (tab.slider(FLEXION) or [None])[0] == value and "extensor" in tab.text(), SLOW)


def test_play_goes_through_the_motion_and_stops(page, tab):
    tab.tick("Play")
    wait_for(lambda: tab.slider(FRAME)[0] >= 2 and degrees(page) > 1.0, SLOW)
    tab.tick("Play")
    wait_for(lambda: not page.panel.play.value and arrived(page), SLOW)
    frame = page.panel.frame.value
    assert degrees(page) == pytest.approx(2.0 * frame)


def test_second_model_follows_the_same_slider(page, tab):
    before = canvas(tab)
    page.panel.models[1].value = "xpbd"
    wait_for(lambda: "pbd / xpbd" in tab.text(), SLOW)
    assert changed(before, canvas(tab)) > 0.02
    page.panel.colour.value = "distance"
    page.panel.quantity.value = "mean of the colour"
    page.panel.controls["hip.flexion"].value = 6.0
    for side in (0, 1):
        wait_for(lambda side=side: abs(degrees(page, side) - 6.0) < 1e-6, SLOW)
    wait_for(lambda: len(page.panel._history) > 2, SLOW)
    assert 0.0 < max(page.panel._history[-1]) < 5.0
    page.panel.models[1].value = "none"
    page.panel.colour.value = "group"
    page.panel.quantity.value = "none"
    wait_for(lambda: page.sides[1].figure is None, SLOW)


def test_play_bar_and_sliders_agree_whichever_is_moved(page):
    panel, slider = page.panel, page.panel.controls["hip.flexion"]
    wait_for(lambda: arrived(page), SLOW)
    slider.value = 6.2  # frames are at 0, 2, 4, 6 and 8 degrees
    wait_for(lambda: panel.frame.value == 3 and arrived(page), SLOW)
    assert slider.value == 6.2
    panel.frame.value = 1
    wait_for(lambda: slider.value == pytest.approx(2.0) and arrived(page), SLOW)
    assert panel.frame.value == 1
    page._touch(rest=True)
    wait_for(lambda: panel.frame.value == 0 and arrived(page), SLOW)
    assert slider.value == 0.0


def test_models_side_by_side_have_their_names_above_them(page):
    captions = [side.caption for side in page.sides]
    assert not any(caption.visible for caption in captions)
    page.panel.models[1].value = "xpbd"
    wait_for(lambda: captions[1].visible, SLOW)
    assert [(c.text, c.visible) for c in captions] == [("pbd", True), ("xpbd", True)]
    tops = [np.concatenate(side.points())[:, 2].max() for side in page.sides]
    for caption, top in zip(captions, tops):
        assert caption.position[2] > 0.001 * top  # the phantom is in mm, and stands upright
    page.panel.models[1].value = "none"
    wait_for(lambda: page.sides[1].figure is None and not captions[0].visible, SLOW)


def test_buttons_turn_the_camera_of_their_own_browser(page, tab):
    client = max(page.server.get_clients().values(), key=lambda client: client.client_id)
    # A click while the page is drawn anew may be lost.
    wait_for(lambda: tab.click("Show") or "Beside it" in tab.text(), SLOW)
    tab.click("Top")
    wait_for(lambda: client.camera.position[2] - client.camera.look_at[2] > 0.5, SLOW)
    ahead = client.camera.position - client.camera.look_at
    assert np.abs(ahead[:2]).max() < 0.02 * ahead[2]


def test_solve_error_sets_controls_to_rest_and_says_so(page, tab):
    model = page.sides[0].figure.models[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "begin", Mock(side_effect=np.linalg.LinAlgError("planted")))
        page.panel.controls["hip.flexion"].value = 6.0
        wait_for(lambda: page.panel.controls["hip.flexion"].value == 0.0, SLOW)
    page._touch()
    wait_for(lambda: "planted" in tab.text(), SLOW)


def test_unexpected_error_is_one_line_and_the_page_goes_on(page):
    wait_for(lambda: arrived(page), SLOW)
    with pytest.MonkeyPatch.context() as patch:
        planted = ZeroDivisionError("planted <b>\nbug")
        patch.setattr(page.sides[0].figure, "advance", Mock(side_effect=planted))
        page.panel.controls["hip.flexion"].value = 4.0
        said = "A bug: ZeroDivisionError: planted &lt;b&gt; bug; press Rest"
        wait_for(lambda: said in page.panel._numbers.content, SLOW)
    page.panel.controls["hip.flexion"].value = 6.0
    wait_for(lambda: abs(degrees(page) - 6.0) < 1e-6, SLOW)
    page._touch(rest=True)
    wait_for(lambda: page.panel.controls["hip.flexion"].value == 0 and arrived(page), SLOW)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="other systems have one loopback address"
)
def test_server_listens_on_one_address(page):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", urlsplit(page.address).port), timeout=5)


def test_notebook_shows_a_scene_and_a_run():
    shown = rm.show(rm.simulate(rm.phantom_scene(end=0.0, spacing=6.0), model="pbd"))
    try:
        assert f'<iframe src="{shown.address}"' in shown._repr_html_()
        names = {muscle.name for muscle in rm.phantom_scene().muscles}
        assert (
            set(shown.sides[0].picture.surfaces) == names
        )  # at rest: the models are not built yet
        wait_for(lambda: set(shown.sides[0].numbers) == names, SLOW)
    finally:
        shown.close()
