"""Chromium without a display, driven over its DevTools protocol with the websockets package that
viser brings.
"""

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request

import numpy as np

SIZE = (750, 500)
# Drawing in software, so that it works where there is no graphics card; root may not use the
# sandbox.
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--remote-debugging-port=0",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "about:blank",
)


# The page warns where drawing is in software, over the picture.
NO_NOTES = (
    "addEventListener('DOMContentLoaded', () => document.head.insertAdjacentHTML('beforeend',"
    "'<style>.mantine-Notifications-root{display:none}</style>'))"
)


class Browser:
    """A Chromium process; ``open`` gives a tab."""

    def __init__(self):
        self.folder = tempfile.mkdtemp()
        words = ["chromium", f"--user-data-dir={self.folder}", *OPTIONS]
        self.process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.port = wait_for(self._port, 60)

    def _port(self):
        try:
            with open(f"{self.folder}/DevToolsActivePort", encoding="utf-8") as file:
                return file.readline().strip()
        except OSError:
            return None

    def open(self, address, size=SIZE):
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new", method="PUT")
        with urllib.request.urlopen(request) as answer:
            return Tab(json.load(answer)["webSocketDebuggerUrl"], address, size)

    def close(self):
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)


class Tab:
    """A tab: JavaScript, mouse and pictures."""

    def __init__(self, debugger, address, size):
        from websockets.sync.client import connect

        self.socket, self.count = connect(debugger, max_size=None), 0
        width, height = size
        screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **screen)
        self.call("Page.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=NO_NOTES)
        self.call("Page.navigate", url=address)

    def call(self, method, **parameters):
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self.socket.recv(timeout=60))
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def run(self, script):
        """Value of a script."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def text(self):
        return self.run("document.body ? document.body.innerText : ''") or ""

    def place(self, condition):
        """Middle of the first innermost element for which a condition on ``e`` holds, None where
        there is none.
        """
        return self.run(
            f"(() => {{ const e = [...document.querySelectorAll('*')].find(e => {condition});"
            "if (!e) return null; const r = e.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2] })()"
        )

    def close(self):
        self.call("Page.close")
        self.socket.close()

    def mouse(self, kind, place):
        self.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=place[0],
            y=place[1],
            button="left",
            clickCount=1,
        )

    def click(self, text):
        """Click on what has this text."""
        self._press(f"!e.children.length && e.textContent.trim() == {text!r}")

    def tick(self, label):
        """Click on the checkbox in the row of a label."""
        self._press(
            "e.type == 'checkbox' && e.closest('.mantine-Flex-root')?.innerText.trim() == "
            f"{label!r}"
        )

    def _press(self, condition):
        place = wait_for(lambda: self.place(condition), 20)
        self.mouse("mousePressed", place)
        self.mouse("mouseReleased", place)

    def slider(self, number):
        """Value of a slider, its handle's place, and those of the ends of its track."""
        return self.run(
            "(() => "
            f"{{ const e = document.querySelectorAll('[role=slider]')[{number}];"
            "if (!e) return null;"
            "const r = e.getBoundingClientRect(), t = e.parentElement.getBoundingClientRect();"
            "const y = r.y + r.height / 2, x = r.x + r.width / 2;"
            "return [Number(e.ariaValueNow), [x, y], [t.left, y], [t.right, y]] })()"
        )

    def drag(self, number, share):
        """Drag a slider's handle to a share of its track, on the way through others."""
        _, handle, left, right = wait_for(lambda: self.slider(number), 20)
        self.mouse("mousePressed", handle)
        end = left[0] + share * (right[0] - left[0])
        for x in np.linspace(handle[0], end, 4)[1:]:
            self.mouse("mouseMoved", (x, handle[1]))
        self.mouse("mouseReleased", (end, handle[1]))

    def picture(self):
        """The tab as an image (h, w, 3)."""
        from PIL import Image

        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def wait_for(find, seconds):
    """What ``find`` gives as soon as it is true."""
    end = time.monotonic() + seconds
    while True:
        found = find()
        if found or time.monotonic() > end:
            assert found, f"not within {seconds} s"
            return found
        time.sleep(0.05)
