"""The page of the viewer: what viser's nodes show of controls and models, and the gate before its server."""

import http.client
import socket
import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbfmuscle as rm

pytest.importorskip("viser")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rbfmuscle.viewer.page import STANDS, Page
from rbfmuscle.viewer.sources import LiveSource


def wait_for(find, seconds=120.0):
    """A busy machine may take long."""
    end = time.monotonic() + seconds
    while not find():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def opened():
    scene = rm.phantom_scene(end=8.0, step=2.0, spacing=6.0)
    scene.joints[0].frame[:3, 3] = [0.0, 5.0, 0.0]  # so that the femur is shifted as it turns
    made = Page(LiveSource(scene, "pbd"))
    yield made
    made.close()


@pytest.fixture
def page(opened):
    """The page, which is at rest before and after."""
    opened.panel.play.value = False
    opened._touch(rest=True)
    wait_for(lambda: opened.panel.controls["hip.flexion"].value == 0 and arrived(opened))
    return opened


def arrived(page):
    figure = page.sides[0].figure
    return (
        figure is not None and not figure.pending and not page._resting and page._shown == page.panel.look()
    )


def degrees(page, side=0):
    return float(np.degrees(page.sides[side].figure.session.here["hip.flexion"]))


def text(page):
    return page.panel._numbers.content


def shown(page):
    """Whether nodes stand where all bones and muscles are, in metres."""
    side, same = page.sides[0], []
    if set(side._nodes) != {*page.source.bones, *page.source.muscles}:
        return False
    for name, (vertices, _) in side.picture.surfaces.items():
        same.append(np.allclose(side._nodes[name].vertices, 1e-3 * vertices, atol=1e-6))
    for name in page.source.bones:
        (w, *xyz), pose = side._nodes[name].wxyz, side.picture.poses[name]
        same.append(np.allclose(Rotation.from_quat([*xyz, w]).as_matrix(), pose[:3, :3], atol=1e-6))
        same.append(np.allclose(side._nodes[name].position, 1e-3 * pose[:3, 3], atol=1e-6))
    return all(same)


def test_page_shows_bones_muscles_and_numbers(page):
    wait_for(lambda: shown(page) and "in bones [mm]" in text(page))
    assert "ms per picture" in text(page) and "extensor" in text(page)


def test_a_slider_moves_numbers_bones_and_muscles(page):
    before = np.array(page.sides[0]._nodes["extensor"].vertices)
    page.panel.controls["hip.flexion"].value = 24.0
    wait_for(lambda: abs(degrees(page) - 24.0) < 1e-6 and arrived(page))
    wait_for(lambda: shown(page))
    assert np.abs(page.sides[0]._nodes["extensor"].vertices - before).max() > 5e-3


def test_play_goes_through_the_motion_and_stops(page):
    page.panel.play.value = True
    wait_for(lambda: page.panel.frame.value >= 2 and degrees(page) > 1.0)
    page.panel.play.value = False
    wait_for(lambda: arrived(page))
    assert degrees(page) == pytest.approx(2.0 * page.panel.frame.value)


def test_colours_hidden_muscles_and_a_cut_change_what_is_shown_and_go_again(page):
    side, scale = page.sides[0], "Depth in a bone [mm]"
    node, whole = side._nodes["extensor"], len(side._nodes["extensor"].faces)
    for element, value, usual, seen in (
        (page.panel.colour, "penetration", "group", lambda: side._painted and scale in text(page)),
        (page.panel.eyes["extensor"], False, True, lambda: not node.visible),
        (page.panel.cut, "z", "none", lambda: 0 < len(node.faces) < whole),
    ):
        element.value = value
        wait_for(seen)
        element.value = usual
        wait_for(lambda: node.visible and len(node.faces) == whole and scale not in text(page))


def test_second_model_follows_the_same_slider(page):
    page.panel.models[1].value = "xpbd"
    wait_for(lambda: "pbd / xpbd" in text(page))
    assert page.sides[1].frame.visible and page.sides[1].frame.position[0] != 0.0
    page.panel.colour.value = "distance"
    page.panel.quantity.value = "mean of the colour"
    page.panel.controls["hip.flexion"].value = 6.0

    wait_for(lambda: max(abs(degrees(page, side) - 6.0) for side in (0, 1)) < 1e-6)
    wait_for(lambda: len(page.panel._history) > 2)
    assert 0.0 < max(page.panel._history[-1]) < 5.0
    for element, value in (
        (page.panel.models[1], "none"),
        (page.panel.colour, "group"),
        (page.panel.quantity, "none"),
    ):
        element.value = value
    wait_for(lambda: page.sides[1].figure is None)


def test_a_view_looks_along_its_axis(page):
    camera = SimpleNamespace()
    page._aim(STANDS["Top"], camera)
    ahead = camera.position - camera.look_at
    assert ahead[2] > 0.5 and np.abs(ahead[:2]).max() < 1e-6 * ahead[2]


def test_solve_error_sets_controls_to_rest_and_says_so(page):
    model = page.sides[0].figure.session.models[0]
    healthy = model.solve

    def broken(contacts):
        raise np.linalg.LinAlgError("planted")

    model.solve = broken
    page.panel.controls["hip.flexion"].value = 6.0
    wait_for(lambda: page.panel.controls["hip.flexion"].value == 0.0)
    model.solve = healthy
    page._touch()
    wait_for(lambda: "planted" in text(page))


def status(page, path, host=None):
    place = urlsplit(page.address).netloc
    client = http.client.HTTPConnection(place, timeout=20)
    client.request("GET", path, headers={"Host": host or place})
    try:
        return client.getresponse().status
    finally:
        client.close()


def test_page_is_given_for_the_token_and_own_host_name_alone(page):
    parts = urlsplit(page.address)
    right = parts.path
    assert status(page, right) == status(page, right, f"localhost:{parts.port}") == 200
    for wrong in ("/", "/index.html", right[:-2] + "/", right.replace("/", "/x", 1), "/?" + right):
        assert status(page, wrong) == 403
    assert status(page, right, f"rebound.example:{parts.port}") == 403


@pytest.mark.parametrize(
    ("origin", "path", "opens"),
    [
        ("own", "right", True), ("own", "wrong", False), ("http://evil.example", "right", False),
        ("null", "right", False), (None, "right", False),
    ],
)  # fmt: skip
def test_websocket_opens_for_the_own_page_alone(page, origin, path, opens):
    import viser

    parts = urlsplit(page.address)
    origin = f"http://{parts.netloc}" if origin == "own" else origin
    target = f"ws://{parts.netloc}{parts.path.rstrip('/')}{'' if path == 'right' else 'x'}"

    expected = nullcontext() if opens else pytest.raises(InvalidStatus, match="403")
    with expected, connect(target, origin=origin, subprotocols=[f"viser-v{viser.__version__}"]) as socket:
        assert socket.recv(timeout=20)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have one loopback address")
def test_server_listens_on_one_address(page):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", urlsplit(page.address).port), timeout=5)


def test_notebook_shows_a_scene_and_a_run():
    shown = rm.simulate(rm.phantom_scene(end=0.0, spacing=6.0), model="pbd").show()
    try:
        assert f'<iframe src="{shown.address}"' in shown._repr_html_()
        names = {muscle.name for muscle in rm.phantom_scene().muscles}
        wait_for(lambda: set(shown.sides[0].numbers) == names)
    finally:
        shown.close()
