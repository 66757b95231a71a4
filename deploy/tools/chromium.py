"""Headless Chromium: opens pages, sends mouse and keyboard, reads values, and keeps what the console reports.

Speaks the DevTools protocol over the browser's pipe (`--remote-debugging-pipe`): JSON, a zero byte after each message.
"""

import base64
import json
import os
import pathlib
import select
import shutil
import subprocess
import time

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--remote-debugging-pipe")
# Longest time of one answer of the browser.
SECONDS = 30
KEYS = {" ": (32, "Space"), "ArrowLeft": (37, "ArrowLeft"), "ArrowRight": (39, "ArrowRight")}


class BrowserError(Exception):
    """The browser refused something, or is gone."""


def program() -> str | None:
    """Path of the browser; None: there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """A browser with an empty profile in `folder`."""

    def __init__(self, folder: pathlib.Path):
        commands, self.commands = os.pipe()
        self.answers, answers = os.pipe()
        # The browser reads file 3 and writes file 4.
        script = f'exec "$@" 3<&{commands} 4>&{answers}'
        command = ["bash", "-c", script, "bash", program(), *FLAGS, f"--user-data-dir={folder}"]
        self.log = (folder / "browser.log").open("w")
        self.process = subprocess.Popen(command, pass_fds=(commands, answers), stdout=self.log, stderr=self.log)
        os.close(commands)
        os.close(answers)
        self.number = 0
        self.rest = b""
        self.tabs: dict[str, Tab] = {}

    def call(self, method: str, session: str | None = None, **parameters):
        """Result of a method; events that arrive before it go to their tabs."""
        number = self.send(method, session, **parameters)
        while True:
            answer = self.read()
            if answer.get("id") == number:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            tab = self.tabs.get(answer.get("sessionId"))
            if tab and "method" in answer:
                tab.take(answer["method"], answer["params"])

    def send(self, method: str, session: str | None = None, **parameters) -> int:
        """Calls a method without waiting for its result; the number of the call."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self.commands, data):]
        return self.number

    def read(self) -> dict:
        while b"\0" not in self.rest:
            if not select.select([self.answers], [], [], SECONDS)[0]:
                raise BrowserError(f"no answer of the browser within {SECONDS} s")
            piece = os.read(self.answers, 1 << 20)
            if not piece:
                raise BrowserError(f"the browser has ended; see {self.log.name}")
            self.rest += piece
        message, self.rest = self.rest.split(b"\0", 1)
        return json.loads(message)

    def close(self) -> None:
        try:
            self.call("Browser.close")
        except (BrowserError, OSError):
            self.process.kill()
        self.process.wait()
        self.log.close()


class Tab:
    """A page in a window of its own, `width` x `height` CSS pixels.

    `script` runs before those of the page. `files` maps paths of the server to local files that are shown instead.
    """

    def __init__(self, browser: Chromium, width: int, height: int, script: str = "",
                 files: dict[str, pathlib.Path] | None = None):
        self.browser, self.width, self.height = browser, width, height
        self.problems: list[str] = []
        self.files = files or {}
        target = browser.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        self.session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        browser.tabs[self.session] = self
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        if self.files:
            self.call("Fetch.enable", patterns=[{"urlPattern": f"http://*{path}"} for path in self.files])
        is_phone = width < 600
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=is_phone)
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def call(self, method: str, **parameters):
        return self.browser.call(method, self.session, **parameters)

    def take(self, method: str, event: dict) -> None:
        """Notes what an event says is wrong."""
        if method == "Runtime.exceptionThrown":
            details = event["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and event["type"] in ("error", "warning", "assert"):
            self.problems.append(" ".join(str(value.get("value", value.get("description"))) for value in event["args"]))
        elif method == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self.problems.append(f"{event['entry']['text']} {event['entry'].get('url', '')}".strip())
        elif method == "Network.responseReceived" and event["response"]["status"] >= 400:
            self.problems.append(f"{event['response']['status']} {event['response']['url']}")
        elif method == "Network.loadingFailed" and not event.get("canceled"):
            self.problems.append(f"a request failed: {event['errorText']}")
        elif method == "Fetch.requestPaused":
            self.replace(event)

    def replace(self, event: dict) -> None:
        """Answers a request with a local file."""
        path = event["request"]["url"].split("/", 3)[3].split("?")[0].split("#")[0]
        file = self.files.get(f"/{path}")
        if file is None:
            self.browser.send("Fetch.continueRequest", self.session, requestId=event["requestId"])
            return
        kinds = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
        headers = [{"name": "Content-Type", "value": f"{kinds[file.suffix]}; charset=utf-8"}]
        body = base64.b64encode(file.read_bytes()).decode()
        self.browser.send("Fetch.fulfillRequest", self.session, requestId=event["requestId"], responseCode=200,
                          responseHeaders=headers, body=body)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete'")

    def value(self, expression: str):
        """Value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise BrowserError(f"{expression}: {answer['exceptionDetails']['exception'].get('description')}")
        return answer["result"].get("value")

    def wait(self, expression: str, seconds: float = 10):
        """First true value of an expression, or the last one in `seconds`."""
        end = time.monotonic() + seconds
        while not (value := self.value(expression)) and time.monotonic() < end:
            time.sleep(0.05)
        return value

    def mouse(self, kind: str, x: float, y: float, buttons: int = 0) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Presses the mouse at `start`, and lets go at `end`."""
        self.mouse("mouseMoved", *start)
        self.mouse("mousePressed", *start, buttons=1)
        if start != end:
            self.mouse("mouseMoved", *end, buttons=1)
        self.mouse("mouseReleased", *end)

    def click(self, x: float, y: float) -> None:
        self.drag((x, y), (x, y))

    def click_on(self, selector: str) -> None:
        """Clicks on the middle of an element, which is scrolled into view."""
        self.value(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})")
        x, y, width, height = self.box(selector)
        self.click(x + width / 2, y + height / 2)

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element in the window."""
        box = self.value(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")
        return box["x"], box["y"], box["width"], box["height"]

    def slide(self, selector: str, share: float) -> None:
        """Drags the thumb of a slider to a share of its way."""
        self.value(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'nearest'}})")
        x, y, width, height = self.box(selector)
        thumb = 16
        at = x + thumb / 2 + (width - thumb) * share
        self.drag((at - 1, y + height / 2), (at, y + height / 2))

    def key(self, name: str) -> None:
        code, where = KEYS[name]
        text = {"text": name} if len(name) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=name, code=where, windowsVirtualKeyCode=code, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=name, code=where, windowsVirtualKeyCode=code)

    def dark(self, is_dark: bool) -> None:
        value = "dark" if is_dark else "light"
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": value}])

    def screenshot(self, file: pathlib.Path) -> None:
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))
