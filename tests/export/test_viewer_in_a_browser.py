"""The viewer's page in a headless Chromium: it opens without an error, shows the sliders, and a moved slider moves the
part."""

import json
import re
import shutil
import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest
from toy import toy_scene, toy_twin

from p2gs.export.run_folder import write_twin

pytest.importorskip("viser", reason="viser is not installed (pip install p2gs[viewer])")
from websockets.sync.client import connect  # viser brings it

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--window-size=900,600",
]


class Page:
    """A tab spoken to by the Chrome DevTools protocol. said: errors that it told of so far."""

    def __init__(self, socket):
        self.socket, self.number, self.said = socket, 0, []
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method, **params):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": params}))
        while True:
            told = json.loads(self.socket.recv(timeout=60))
            if told.get("id") == self.number:
                return told["result"]
            event = told.get("params", {})
            if told.get("method") == "Runtime.exceptionThrown":
                self.said.append(event["exceptionDetails"]["text"])
            elif told.get("method") == "Runtime.consoleAPICalled" and event["type"] == "error":
                self.said.append(str(event["args"]))
            elif told.get("method") == "Log.entryAdded" and event["entry"]["level"] == "error":
                self.said.append(event["entry"]["text"])

    def value(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def picture(self) -> np.ndarray:
        import base64

        import cv2

        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)

    def until(self, expression, seconds=60):
        """Wait until the page says yes."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"{expression} never came true; the page said {self.said}"
            time.sleep(0.2)


@contextmanager
def browsed(url, folder):
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None) or pytest.skip("no Chromium here")
    words = [browser, *FLAGS, f"--user-data-dir={folder}", url]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        line = next(text for text in process.stderr if "DevTools listening" in text)
        address = re.search(r"ws://([^/]+)", line)[1]
        with connect(f"ws://{address}/devtools/page/{tab(address)}", max_size=None) as socket:
            yield Page(socket)
    finally:
        process.kill()
        process.wait()


def tab(address) -> str:
    from urllib.request import urlopen

    end = time.monotonic() + 20
    while time.monotonic() < end:
        pages = [t for t in json.load(urlopen(f"http://{address}/json")) if t["type"] == "page"]
        if pages:
            return pages[0]["id"]
        time.sleep(0.2)
    raise AssertionError("the browser opened no page")


def test_a_slider_moves_its_part(tmp_path):
    from p2gs.export.pages.viewer import open_viewer

    run = tmp_path / "run"
    write_twin(toy_twin(), run, toy_scene(n=6, size=48), media=False)
    server = open_viewer(run, port=18090)
    try:
        with browsed(f"http://127.0.0.1:{server.get_port()}", tmp_path / "profile") as page:
            page.until("document.body.innerText.includes('part 1')")
            assert page.value("document.querySelectorAll('[role=slider]').length") >= 2
            page.until("document.querySelector('canvas') !== null")
            before = still(page)
            assert before.std() > 2  # not an empty view
            slider = "document.querySelectorAll('[role=slider]')[0]"
            # with the mouse: the arrow keys turn viser's camera, too
            track = f"{slider}.parentElement.getBoundingClientRect()"
            x = page.value(f"{track}.left + {track}.width * 0.8")
            y = page.value(f"{track}.top + {track}.height / 2")
            for kind in ("mousePressed", "mouseReleased"):
                page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
            page.until(f"Number({slider}.getAttribute('aria-valuenow')) > 0.5")
            assert changed(page, lambda shot: (np.abs(shot - before)[:, :560].max(-1) > 30).sum() > 30)
            # viser's own splats have corners of two numbers, which three.js finds no sphere about
            assert [text for text in page.said if "computeBoundingSphere" not in text] == []
    finally:
        server.stop()


def changed(page, holds, seconds=40) -> bool:
    """Whether the page's picture comes to be such that ``holds``."""
    end = time.monotonic() + seconds
    while not (there := holds(page.picture())) and time.monotonic() < end:
        time.sleep(0.5)
    return there


def still(page, seconds=40) -> np.ndarray:
    """The page's picture once two in a row are the same."""
    end, last = time.monotonic() + seconds, page.picture()
    while time.monotonic() < end:
        time.sleep(1)
        shot = page.picture()
        if np.abs(shot - last).max() < 8:
            return shot
        last = shot
    return last
